"""Automatic views in a run: which way is up, and the near plane of small scenes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.render import LABEL, WIDTH, draw_sheet
from flexgs_edge.commands.view import view
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.errors import BudgetError, DeviceError, InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.quality.psnr import LONE_BASES, MOVED, lone_base, moved_error
from flexgs_edge.run.options import CompressOptions, ViewOptions
from flexgs_edge.run.run import open_compression, open_run
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.source import MemorySource
from synthetic import make_camera, make_splats


def scene(scale: float) -> MemorySource:
    points = np.random.default_rng(0).normal(size=(200, 3)) * scale
    return make_splats(points, np.full((200, 3), 0.1 * scale))


@pytest.fixture
def lone(tmp_path: Path) -> Path:
    """A scene of ordinary size, without cameras."""
    write_ply(tmp_path / "lone.ply", scene(1.0))
    return tmp_path / "lone.ply"


def test_a_small_scene_lowers_the_near_plane(tmp_path: Path, lone: Path) -> None:
    run = open_run(lone, ViewOptions())
    assert run.options.near == DEFAULT_NEAR and not any("near plane" in note for note in run.seen.notes)
    write_ply(tmp_path / "small.ply", scene(1e-3))
    run = open_run(tmp_path / "small.ply", ViewOptions())
    assert run.options.near is not None and run.options.near < 2e-3
    assert f"near plane {run.options.near:g} instead of 0.2" in run.seen.notes[-1]
    # What the user asks for stays.
    assert open_run(tmp_path / "small.ply", ViewOptions(near=0.5)).options.near == 0.5
    # Cameras of the user's own keep the usual near plane.
    given = GivenViews([make_camera()])
    assert open_run(tmp_path / "small.ply", ViewOptions(), given=given).options.near == DEFAULT_NEAR


def test_up_turns_automatic_views(lone: Path) -> None:
    run = open_run(lone, ViewOptions(up=(1.0, 0.0, 0.0)))
    assert "up is +x (--up)" in run.seen.notes[0]
    assert all(abs(camera.rotation[0, 0]) < 1e-12 for camera in run.seen.cameras)
    assert "up is -y (convention)" in open_run(lone, ViewOptions()).seen.notes[0]


def test_a_large_scene_is_not_fine_tuned_to_automatic_views(lone: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexgs_edge.run.run.LARGE", 100)
    run = open_compression(lone, None, CompressOptions(dry_run=True))
    assert run.options.effort == "fast" and not run.options.finetunes and "works as --effort fast" in run.warnings[-1]
    for options, given in (
        (CompressOptions(dry_run=True, distil=9), None),
        (CompressOptions(dry_run=True, holdout=0, select="train"), GivenViews([make_camera()])),
    ):
        run = open_compression(lone, None, options, given=given)
        assert run.options.effort == "balanced" and run.options.finetunes and not run.warnings


@pytest.mark.parametrize("kind", [DeviceError, BudgetError])
def test_a_page_needs_no_device(
    tmp_path: Path, lone: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, kind: type[Exception]
) -> None:
    def fail(*_: object) -> None:
        raise kind("no device here")

    monkeypatch.setattr("flexgs_edge.run.view_set.counted_backend", fail)
    assert view(lone, tmp_path / "a.html").views == 0
    assert "opens without prepared views: no device here" in caplog.text
    with pytest.raises(kind):
        view(lone, tmp_path / "b.html", device="cpu")


def test_a_sheet_shows_all_views(tmp_path: Path, lone: Path) -> None:
    from PIL import Image

    result = draw_sheet(lone, tmp_path / "sheet.png")
    assert result.views.total == len(result.view_seconds) >= 40
    picture = np.asarray(Image.open(tmp_path / "sheet.png"))
    across, down = picture.shape[1] // WIDTH, picture.shape[0] // (LABEL + WIDTH * 3 // 4)
    assert across * down >= result.views.total > across * (down - 1) and across > down
    # Every view has a name and shows something.
    first = picture[:LABEL, :WIDTH], picture[LABEL : LABEL + 240, :WIDTH]
    assert first[0].max() > 200 and first[1].std() > 5
    with pytest.raises(InputError, match=r"expected a name that ends in \.png"):
        draw_sheet(lone, tmp_path / "sheet")


def test_the_base_follows_from_the_detail_of_the_pictures() -> None:
    rng = np.random.default_rng(0)
    flat, rough = np.full((60, 80, 3), 0.5, np.float32), rng.uniform(0, 1, (60, 80, 3)).astype(np.float32)
    ramp = np.broadcast_to(np.linspace(0, 1, 80, dtype=np.float32)[None, :, None], (60, 80, 3))
    assert moved_error(flat, 1 / MOVED) == 0 and moved_error(rough, 1 / MOVED) > 0.1
    # A ramp that is moved by a pixel changes by 1 / 79, in one of the two directions.
    assert moved_error(ramp, 1 / MOVED) == pytest.approx(0.5 / 79**2, rel=1e-3)
    assert moved_error(ramp, 0.5 / MOVED) == pytest.approx(0.125 / 79**2, rel=1e-3)
    least, finetuned, largest = LONE_BASES
    assert lone_base([0.0], [1.0], True) == lone_base([0.0], [1.0], False) == largest
    assert lone_base([1.0], [1.0], True) == finetuned and lone_base([1.0], [1.0], False) == least


@pytest.mark.parametrize(
    ("cameras", "given"),
    [("none", None), ("poses.json", None), (None, [make_camera()])],
    ids=["none", "file", "memory"],
)
def test_up_is_refused_where_cameras_are_not_automatic(
    lone: Path, cameras: str | None, given: list[Camera] | None
) -> None:
    with pytest.raises(InputError, match=f"--up turns automatic views, but cameras come from {cameras or 'memory'}"):
        open_run(lone, ViewOptions(cameras=cameras, up=(0.0, 0.0, 1.0)), given=GivenViews(given))
