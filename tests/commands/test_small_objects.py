"""Scenes that fill little of their views, and scenes of hardly anything: the scene decides, and something is always left."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.io.formats import FORMATS, WRITTEN
from flexgs_edge.io.ply import write_ply
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from scene_files import open_scene
from synthetic import look_from, make_camera, random_scene

FAST: dict[str, Any] = {"effort": "fast", "holdout": 4}


def views(width: int = 80, height: int = 60, focal: float = 60.0, count: int = 8) -> GivenViews:
    """Poses around the middle of `random_scene`, none of them along an axis."""
    cameras: list[Camera] = []
    for index in range(count):
        rotation, translation = look_from(index)
        cameras.append(make_camera(width, height, focal, rotation, translation, name=f"v{index}"))
    return GivenViews(cameras)


def planes_of(count: int, degree: int, shape: str) -> dict[str, np.ndarray]:
    """A scene of `count` Gaussians around (0, 0, 4), of a degenerate shape."""
    planes = random_scene(count, 11, degree, size=-1.5, opacity=2.0).read(slice(0, count), list(FIELD))
    middle = np.array([[0.1], [-0.2], [4.0]], np.float32)
    along = np.linspace(-0.8, 0.8, count, dtype=np.float32) if count > 1 else np.zeros(1, np.float32)
    if shape == "at one point":
        planes["means"][:] = middle
    elif shape == "on a line":
        planes["means"] = middle + along * np.array([[1.0], [0.3], [0.2]], np.float32)
    elif shape == "behind each other":
        planes["means"] = middle + along * np.array([[0.0], [0.0], [1.0]], np.float32)
    elif shape == "in a plane":
        planes["means"][1] = -0.2
    elif shape == "two groups far apart":
        planes["means"][0, count // 2 :] += 1000.0
    elif shape == "small and far apart":
        planes["means"] *= 1e5
        planes["log_scales"] -= 4.0
    elif shape == "SH of zero":
        planes["sh_rest"][:] = 0
    elif shape == "all alike":
        planes = {name: np.repeat(values[:, :1], count, axis=1) for name, values in planes.items()}
        planes["means"][:] = middle
    else:
        assert shape == "cloud"
    return planes


def scene(folder: Path, count: int, degree: int = 0, shape: str = "cloud") -> Path:
    path = folder / "scene.ply"
    write_ply(path, MemorySource(planes_of(count, degree, shape), degree))
    return path


SHAPES = [
    (1, 0, "cloud"),
    (1, 3, "cloud"),
    (3, 0, "cloud"),
    (50, 3, "cloud"),
    (12, 1, "at one point"),
    (12, 2, "on a line"),
    (12, 1, "behind each other"),
    (40, 1, "in a plane"),
    (40, 1, "two groups far apart"),
    (20, 3, "SH of zero"),
    (20, 2, "all alike"),
]


@pytest.mark.parametrize(("count", "degree", "shape"), SHAPES)
@pytest.mark.parametrize("words", [{}, {"method": "paper"}], ids=["best", "paper"])
def test_every_scene_comes_back(tmp_path: Path, count: int, degree: int, shape: str, words: dict[str, Any]) -> None:
    path = scene(tmp_path, count, degree, shape)
    result = compress(path, tmp_path / "a.fgs", given=views(), best_effort=True, **FAST, **words)
    assert 1 <= result.count <= count
    assert decompress(tmp_path / "a.fgs", tmp_path / "a.ply").scene.count == result.count


@pytest.mark.parametrize("suffix", [suffix for suffix in WRITTEN if not FORMATS[suffix].needs])
@pytest.mark.parametrize("degree", [0, 1])
def test_other_formats_of_three_gaussians(tmp_path: Path, suffix: str, degree: int) -> None:
    path, file = scene(tmp_path, 3, degree), tmp_path / f"a{suffix}"
    result = compress(path, file, given=views(), best_effort=True, **FAST)
    assert 1 <= result.count <= 3 and open_scene(file).count == result.count


def small_object(tmp_path: Path, **words: Any) -> tuple[CompressResult, Path]:
    """An object in 0.2 % of its views, which were thrown away as a whole."""
    path, given = scene(tmp_path, 50, 1), views(320, 240, 8.0)
    return compress(path, tmp_path / "a.fgs", given=given, **FAST, **words), path


@pytest.mark.parametrize("method", ["best", "paper"])
def test_a_small_object_in_a_large_view_is_kept(tmp_path: Path, method: str) -> None:
    result, path = small_object(tmp_path, min_fidelity=30.0, method=method)
    assert result.reached and result.count > 5 and result.quality is not None
    assert result.quality.coverage < 0.005
    fidelity, covered = result.quality.fidelity, result.quality.covered_fidelity
    assert fidelity is not None and covered is not None and covered >= 30.0 and fidelity > covered + 20
    assert "over what the original covers" in result.summary()
    record = result.to_json()
    assert record["quality"]["covered_decides"] and record["quality"]["views"][0]["coverage"] < 0.005
    chosen = min((step for step in record["search"] if step["holds"]), key=lambda step: step["size"])
    assert chosen["covered_fidelity"] >= 30.0 and chosen["fidelity"] > 50.0
    assert open_scene(tmp_path / "a.fgs").count == result.count and path.exists()


def test_the_worst_view_is_judged_by_what_it_covers(tmp_path: Path) -> None:
    result, _ = small_object(tmp_path, max_drop=3.0, max_worst_drop=3.5)
    assert result.search is not None and result.search.chosen.measurement is not None
    worst = result.search.chosen.measurement.worst
    assert worst is not None and worst.covered is not None and 0 < worst.covered.modelled_drop <= 3.5


def test_photos_keep_the_plain_figures(tmp_path: Path) -> None:
    """What decides with photos is what always did, on training poses too; the covered figures are shown beside."""
    path, given = scene(tmp_path, 50, 1), views(160, 120, 8.0)
    photos = [np.full((120, 160, 3), 20, np.uint8) for _ in given.cameras or ()]
    with_photos = GivenViews(given.cameras, photos)
    for select in ("test", "train"):
        words: dict[str, Any] = {**FAST, "select": select, "max_drop": 0.3, "force": True, "trust_views": True}
        result = compress(path, tmp_path / "a.fgs", given=with_photos, **words)
        assert result.search is not None and result.search.chosen.measurement is not None
        assert result.search.chosen.measurement.covered is None and result.quality is not None
        assert not result.quality.covered_decides and "over what the original covers, on" not in result.summary()
        assert result.quality.drop is not None and result.quality.covered_fidelity is not None


@pytest.mark.parametrize("words", [{}, {"method": "paper"}], ids=["best", "paper"])
def test_one_gaussian_is_left_where_a_size_is_out_of_reach(tmp_path: Path, words: dict[str, Any]) -> None:
    path = scene(tmp_path, 3, 1)
    with pytest.raises(TargetError, match="with one Gaussian left"):
        compress(path, tmp_path / "a.fgs", given=views(), max_size=10, **FAST, **words)
    result = compress(path, tmp_path / "a.fgs", given=views(), max_size=10, best_effort=True, **FAST, **words)
    assert result.reached is False and result.count == 1
    assert decompress(tmp_path / "a.fgs", tmp_path / "a.ply").scene.count == 1


def test_a_default_target_out_of_reach_still_makes_a_file(tmp_path: Path) -> None:
    """Splats far smaller than the finest step of positions. A named target ends in an error instead."""
    path, file = scene(tmp_path, 12, 0, "small and far apart"), tmp_path / "a.fgs"
    result = compress(path, file, **FAST)
    assert result.reached is False and open_scene(file).count == result.count >= 1
    assert any("out of reach" in warning for warning in result.warnings)
    with pytest.raises(TargetError, match="out of reach"):
        compress(path, file, max_drop=1.0, force=True, **FAST)


def test_a_loose_target_keeps_one(tmp_path: Path) -> None:
    path = scene(tmp_path, 20, 1)
    result = compress(path, tmp_path / "a.fgs", given=views(), max_drop=70.0, promise="mean", **FAST)
    assert result.reached and result.count == 1


def test_the_first_layer_is_never_empty(tmp_path: Path) -> None:
    path = scene(tmp_path, 1)
    result = compress(path, tmp_path / "a.fgs", given=views(), layers=4, best_effort=True, **FAST)
    assert result.count == 1 and decompress(tmp_path / "a.fgs", tmp_path / "a.ply").scene.count == 1


@pytest.mark.parametrize("words", [{}, {"method": "paper"}], ids=["best", "paper"])
def test_a_scene_that_nothing_can_show(tmp_path: Path, words: dict[str, Any]) -> None:
    planes = planes_of(10, 0, "cloud")
    planes["opacity_logits"][:] = -9
    write_ply(tmp_path / "faint.ply", MemorySource(planes, 0))
    with pytest.raises(
        InputError, match="no Gaussian is opaque enough to be drawn: all 10 have an opacity below 1/255"
    ):
        compress(tmp_path / "faint.ply", tmp_path / "a.fgs", given=views(), **FAST, **words)
    assert not (tmp_path / "a.fgs").exists()


def test_views_that_see_nothing(tmp_path: Path) -> None:
    path = scene(tmp_path, 10)
    away = [make_camera(40, 30, translation=(0.0, 0.0, -90.0), name=f"v{index}") for index in range(8)]
    for words in (FAST, {**FAST, "method": "paper"}, {**FAST, "unseen": "drop"}):
        with pytest.raises(
            InputError, match=r"none of 2 views sees any Gaussian.*--cameras PATH.*--cameras auto.*--near"
        ):
            compress(path, tmp_path / "a.fgs", given=GivenViews(away), **words)
    # Held-out views see the scene, but those that are scored do not.
    seeing = views(40, 30).cameras
    assert seeing is not None
    mixed = [seeing[index] if index % 4 == 0 else camera for index, camera in enumerate(away)]
    given = GivenViews([replace(camera, name=f"v{index}") for index, camera in enumerate(mixed)])
    with pytest.raises(InputError, match=r"none of 9 scored views sees any Gaussian, and --unseen 0 keeps none"):
        compress(path, tmp_path / "a.fgs", given=given, unseen="drop", **FAST)
    assert compress(path, tmp_path / "a.fgs", given=given, best_effort=True, **FAST).count == 10


def test_evaluate_shows_both_figures(tmp_path: Path) -> None:
    path = scene(tmp_path, 50, 1)
    compress(path, tmp_path / "a.fgs", given=views(320, 240, 8.0), min_fidelity=30.0, **FAST)
    found = evaluate(tmp_path / "a.fgs", path, report=tmp_path / "page", cameras="auto", resolution=80)
    assert found.quality.covered_decides and "covered:" in found.summary()
    page = (tmp_path / "page" / "index.html").read_text()
    assert "fidelity over what the original covers" in page
