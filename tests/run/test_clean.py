"""`--clean`: which Gaussians go, what is said of them, and what is kept beside the result."""

from __future__ import annotations

import base64
import html
import io
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.compress_all import compress_all
from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.clean import cleaned, measure_changes
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run, open_run, planned
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource, SelectSource, read_all
from scene_files import open_scene
from tiny_project import COUNT, FAST, make_project

NEAR, NEEDLE, ALONE, DEAD = range(COUNT, COUNT + 4)
GOES = {NEAR, NEEDLE}
RATES: dict[str, Any] = {**FAST, "prune_rate": 0.1, "sh_rate": 0.1}


def with_floaters(source: SceneSource, camera: Camera) -> MemorySource:
    """A blob before a camera, a needle, matter far behind all others, and what is never drawn, after the scene's own rows."""
    planes = read_all(source, IN_MEMORY)
    ahead = camera.center + camera.rotation.T @ [0.0, 0.0, 0.7]
    places = np.array([ahead, (0.2, 0.2, 1.0), (70.0, 80.0, 90.0), (0.0, 0.0, 4.0)])
    scales = np.log([[0.06] * 3, [0.6, 0.01, 0.01], [0.02] * 3, [0.02] * 3])
    more = {name: np.zeros((source.width(name), 4), np.float32) for name in FIELD}
    more["means"][:] = places.T - source.origin[:, None]
    more["log_scales"][:], more["quats"][0], more["sh_dc"][0] = scales.T, 1.0, 3.0
    more["opacity_logits"][:] = [[4.0, 4.0, 4.0, -9.0]]
    return MemorySource({name: np.hstack([planes[name], more[name]]) for name in FIELD}, origin=source.origin)


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiny project, whose photos do not show the floaters of its scene."""
    folder = make_project(tmp_path_factory.mktemp("cloudy") / "scene")
    place = folder / "point_cloud.ply"
    write_ply(place, with_floaters(open_scene(place), open_run(place, CompressOptions()).seen.cameras[3]), force=True)
    return folder


def opened(project: Path, **words: Any) -> Run[CompressOptions]:
    return planned(open_run(project / "point_cloud.ply", CompressOptions(**words)))


def rows_left(run: Run[CompressOptions]) -> np.ndarray:
    assert isinstance(run.source, SelectSource)
    return run.source.rows


def draw(renderer: Renderer, source: SceneSource, camera: Camera) -> np.ndarray:
    with renderer.load(source) as scene:
        image = renderer.render(scene, camera).copy()
    renderer.release()
    return image


def test_changes_are_those_of_views_drawn_without_the_row(project: Path) -> None:
    """For a target above what can be drawn, so that nothing is clamped."""
    run = opened(project)
    cameras = run.seen.cameras[:3]
    with open_renderer(run) as renderer:
        targets = [draw(renderer, run.source, camera).clip(0, 1) * np.float32(0.9) for camera in cameras]
        changes = measure_changes(renderer, run.source, cameras, lambda place, image: targets[place])
        own = measure_changes(renderer, run.source, cameras)
        for row in (NEAR, NEEDLE, ALONE, DEAD, 5):
            left = run.source.select(np.delete(np.arange(run.source.count), row))
            found = 0.0
            for camera, target in zip(cameras, targets, strict=True):
                before, after = draw(renderer, run.source, camera), draw(renderer, left, camera)
                found += float((np.square(after - target) - np.square(before - target)).sum(dtype=np.float64))
            assert changes.total[row] == pytest.approx(found, rel=0.03, abs=2e-3)
        assert np.array_equal(own.cost, changes.cost) and not own.slope.any() and own.error == 0.0
        assert np.array_equal(own.total, own.cost)


def test_photos_contradict_floaters_alone(project: Path) -> None:
    run = opened(project, clean="gentle")
    with open_renderer(run) as renderer:
        after = cleaned(run, renderer)
    gone = set(range(COUNT + 4)) - set(rows_left(after).tolist())
    assert gone >= {*GOES, DEAD} and len(gone - {*GOES, ALONE, DEAD}) <= 4
    assert {group.kind for group in after.removed} >= {"near cameras", "needles", "invisible"}
    for group in after.removed:
        assert group.gain >= 0 or not group.removed
    best = next(group for group in after.removed if group.kind == "needles")
    assert best.gain > 0.1 and f"{best.count} needles (around" in " ".join(after.source.notes)


def test_without_photos_only_what_lies_alone_goes(project: Path) -> None:
    run = opened(project, clean="thorough", images="none")
    with open_renderer(run) as renderer:
        after = cleaned(run, renderer)
        again = cleaned(replace(run, options=replace(run.options, clean=None)), renderer)
    gone = set(range(COUNT + 4)) - set(rows_left(after).tolist())
    assert gone >= {ALONE, DEAD} and not gone & GOES
    assert again.source is run.source and not again.removed


def test_a_kind_that_views_lose_by_stays(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        "flexgs_edge.run.clean._find", lambda run, renderer, base: np.where(np.arange(COUNT + 4) < 40, 4, -1)
    )
    run = opened(project, clean="gentle")
    with open_renderer(run) as renderer:
        after = cleaned(run, renderer)
    assert after.source.count == run.source.count
    (group,) = after.removed
    assert not group.removed and group.gain < 0 and str(group).endswith("so they stay")


def test_what_went_is_kept_with_its_values(project: Path, tmp_path: Path) -> None:
    kept, out, record = tmp_path / "gone.ply", tmp_path / "a.fgs", tmp_path / "report"
    result = compress(project, out, clean="gentle", keep_removed=str(kept), report=str(record), **RATES)
    removed, whole = open_scene(kept), open_scene(project / "point_cloud.ply")
    found = removed.read(slice(0, removed.count), list(FIELD))
    original = whole.read(np.array([NEAR, NEEDLE]), list(FIELD))
    places = [int(np.flatnonzero((found["means"] == original["means"][:, [i]]).all(axis=0))[0]) for i in range(2)]
    for name in FIELD:
        assert np.array_equal(found[name][:, places], original[name])
    assert removed.count == sum(group.count for group in result.removed if group.removed)
    assert result.scene.count + removed.count == COUNT + 4
    data = json.loads((record / "result.json").read_text())
    assert {group["kind"] for group in data["removed"]} == {group.kind for group in result.removed}
    assert all(set(group) == {"kind", "count", "centre", "gain", "removed"} for group in data["removed"])
    assert "--clean gentle: " in result.summary() and "--clean gentle: " in (record / "index.html").read_text()


def test_a_report_shows_what_went(project: Path, tmp_path: Path) -> None:
    """Before, after, and that alone, in the view that shows most of it: that before which the blob hangs."""
    result = compress(project, None, dry_run=True, clean="gentle", report=str(tmp_path / "report"), **RATES)
    page = (tmp_path / "report" / "index.html").read_text()
    part = page[page.index("<h2>Removed</h2>") :]
    assert all(str(group) in html.unescape(part) for group in result.removed)
    pictures = re.findall(r'<img src="data:image/jpeg;base64,([^"]*)"[^>]*>\s*<figcaption>([^<]*)', part)[:3]
    assert [words for _, words in pictures] == ["before", "after", "what went, alone"]
    before, after, alone = (
        np.asarray(Image.open(io.BytesIO(base64.b64decode(data))), np.float64) for data, _ in pictures
    )
    run = opened(project, clean="gentle")
    name = re.search(r"<p>(.*), the view that shows most of it", part)
    assert name is not None and run.plan is not None
    (camera,) = (one for one in run.seen.of(run.plan.report) if one.name == html.unescape(name[1]))
    with open_renderer(run) as renderer:
        after_cleaning = cleaned(run, renderer)
        assert after_cleaning.removed_rows is not None
        for shown, source in (
            (before, run.source),
            (after, after_cleaning.source),
            (alone, after_cleaning.removed_rows),
        ):
            assert np.abs(shown - 255 * draw(renderer, source, camera).clip(0, 1)).mean() < 3
    assert alone.max() > 60 and np.abs(before - after).mean() > 0.1


def test_a_dry_run_and_nothing_removed_write_no_file(project: Path, tmp_path: Path) -> None:
    kept = tmp_path / "gone.ply"
    words: dict[str, Any] = {"keep_removed": str(kept), **RATES}
    assert compress(project, None, clean="gentle", dry_run=True, **words).removed and not kept.exists()
    clean = make_project(tmp_path / "clean")
    scene = open_scene(clean / "point_cloud.ply")
    drawn = np.flatnonzero(scene.read(slice(0, COUNT), ["opacity_logits"])["opacity_logits"][0] > 0)
    write_ply(clean / "point_cloud.ply", MemorySource(scene.read(drawn, list(FIELD)), origin=scene.origin), force=True)
    result = compress(clean, tmp_path / "b.fgs", clean="gentle", images="none", **words)
    assert not any(group.removed for group in result.removed) and not kept.exists()


def test_invalid_ones_go_too(project: Path, tmp_path: Path) -> None:
    scene = open_scene(project / "point_cloud.ply")
    planes = read_all(scene, IN_MEMORY)
    planes["sh_dc"][0, 7] = np.nan
    broken = tmp_path / "broken.ply"
    write_ply(broken, MemorySource(planes, origin=scene.origin))
    words = {"cameras": str(project / "cameras.json"), **RATES}
    with pytest.raises(InputError, match="NaN"):
        compress(broken, tmp_path / "a.fgs", **words)
    assert (
        "1 of 404 Gaussians left out as invalid"
        in compress(broken, tmp_path / "a.fgs", clean="gentle", **words).summary()
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"keep_removed": "a.ply"}, "--keep-removed: nothing is removed without --clean"),
        ({"clean": "hard"}, "--clean 'hard': expected one of gentle, thorough"),
        ({"clean": "gentle", "keep_removed": "a.spz"}, "--keep-removed a.spz: expected a name that ends in .ply"),
        ({"clean": "gentle", "cameras": "none"}, "--clean gentle: views judge what goes"),
    ],
)
def test_options_that_cannot_be(project: Path, tmp_path: Path, words: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        compress(project, tmp_path / "a.fgs", **{**RATES, **words})
    assert not list(tmp_path.iterdir())


def test_removed_rows_of_several_scenes_have_no_file(project: Path, tmp_path: Path) -> None:
    for name in ("a.ply", "b.ply"):
        (tmp_path / name).write_bytes((project / "point_cloud.ply").read_bytes())
    with pytest.raises(InputError, match="--keep-removed"):
        compress_all(tmp_path, tmp_path / "out", clean="gentle", keep_removed=str(tmp_path / "c.ply"), **RATES)
