"""Scores kept between runs: taken again for the same scene, poses and score, made anew for anything else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import InputError, TargetError
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.run.fingerprint import fingerprint
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from tiny_project import make_project, write_cameras

FIXED: dict[str, Any] = {
    "method": "paper", "holdout": 2, "prune_rate": 0.3, "sh_rate": 0.3, "force": True,
    "resolution": 20,
}  # fmt: skip


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = make_project(tmp_path_factory.mktemp("cached") / "scene", photos=False)
    write_cameras(folder / "cameras.json", views=4)
    return folder


@pytest.fixture(scope="module")
def first(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scores kept by a first run, and its file."""
    folder = tmp_path_factory.mktemp("first")
    result = run(project, folder)
    assert not result.scores_reused and "made anew" in result.summary() and "score" in result.run.stages
    return folder


def run(project: Path, folder: Path, **changes: Any) -> Any:
    options = {**FIXED, "score_cache": str(folder / "s.npz"), **changes}
    return compress(project / "point_cloud.ply", folder / "a.fgs", **options)


@pytest.fixture
def copy(project: Path, first: Path, tmp_path: Path) -> tuple[Path, Path]:
    """Copies of the project and of what the first run left."""
    shutil.copytree(project, tmp_path / "project")
    shutil.copytree(first, tmp_path / "done")
    return tmp_path / "project", tmp_path / "done"


def test_the_second_run_scores_nothing_and_writes_the_same_bytes(copy: tuple[Path, Path], first: Path) -> None:
    project, folder = copy
    kept = (folder / "s.npz").read_bytes()
    result = run(project, folder)
    assert result.scores_reused and "score" not in result.run.stages
    assert f"reused from {folder / 's.npz'}" in result.summary()
    assert result.to_json()["scores_reused"] is True and result.to_json()["score_cache"] == str(folder / "s.npz")
    assert (folder / "a.fgs").read_bytes() == (first / "a.fgs").read_bytes()
    assert (folder / "s.npz").read_bytes() == kept
    # Another target, other bits, other names of the poses: what is scored stays the same.
    cameras = json.loads((project / "cameras.json").read_text())
    for camera in cameras:
        camera["img_name"] = "x" + camera["img_name"]
    (project / "cameras.json").write_text(json.dumps(cameras))
    other = run(project, folder, prune_rate=None, sh_rate=None, max_size=20_000, bits="rest=3", effort="fast")
    assert other.scores_reused


def change_scene(project: Path, field: str = "opacity_logits") -> None:
    """One value of one Gaussian, by a little."""
    source = PlySource(project / "point_cloud.ply")
    arrays = source.read(slice(0, source.count), list(FIELD))
    arrays[field][0, 7] += 1e-3
    (project / "point_cloud.ply").unlink()
    write_ply(project / "point_cloud.ply", MemorySource(arrays, origin=source.origin))


def change_poses(project: Path) -> None:
    cameras = json.loads((project / "cameras.json").read_text())
    cameras[1]["position"][0] += 1e-6
    (project / "cameras.json").write_text(json.dumps(cameras))


@pytest.mark.parametrize("change", [change_scene, change_poses])
def test_another_scene_or_other_poses(copy: tuple[Path, Path], change: Callable[[Path], None]) -> None:
    project, folder = copy
    change(project)
    result = run(project, folder)
    assert not result.scores_reused and "score" in result.run.stages
    fresh = (folder / "a.fgs").read_bytes()
    assert run(project, folder).scores_reused and (folder / "a.fgs").read_bytes() == fresh
    run(project, folder, score_cache=None)
    assert (folder / "a.fgs").read_bytes() == fresh


@pytest.mark.parametrize("options", [{"score": "meson"}, {"resolution": 21, "holdout": 3}], ids=str)
def test_other_options_of_the_score(copy: tuple[Path, Path], options: dict[str, Any]) -> None:
    assert not run(*copy, **options).scores_reused


def test_colours_do_not_count(copy: tuple[Path, Path]) -> None:
    project, folder = copy
    change_scene(project, "sh_dc")
    assert run(project, folder).scores_reused


def test_everything_that_scores_depend_on_is_in_the_fingerprint(project: Path) -> None:
    source = PlySource(project / "point_cloud.ply")
    arrays = source.read(slice(0, source.count), list(FIELD))
    cameras = read_cameras(project / "cameras.json")
    words = ("gs", 0.2)

    def other(field: str) -> MemorySource:
        changed = {**arrays, field: arrays[field].copy()}
        changed[field][-1, -1] = np.nextafter(changed[field][-1, -1], np.float32(np.inf))
        return MemorySource(changed, origin=source.origin)

    plain = MemorySource(arrays, origin=source.origin)
    expected = fingerprint(plain, cameras, *words)
    assert fingerprint(source, cameras, *words) == expected  # whoever reads it, in whatever parts
    assert fingerprint(plain, [replace(camera, name=f"x{camera.name}") for camera in cameras], *words) == expected
    different = [fingerprint(other(field), cameras, *words) for field in FIELD if not field.startswith("sh_")]
    different.append(fingerprint(MemorySource(arrays, origin=source.origin + 1e-9), cameras, *words))
    different.append(fingerprint(plain.select(np.arange(1, 400)), cameras, *words))
    different += [fingerprint(plain, cameras, *w) for w in (("meson", 0.2), ("gs", 0.3))]
    different += [fingerprint(plain, poses, *words) for poses in (cameras[1:], cameras[::-1])]
    different.append(fingerprint(plain, cameras, *words, antialiased=True))
    one = cameras[0]
    turned = np.nextafter(one.rotation, 2)
    for change in (
        {"width": 41}, {"height": 31}, {"fx": one.fx + 1e-9}, {"fy": one.fy + 1e-9}, {"cx": one.cx + 1e-9},
        {"cy": one.cy + 1e-9}, {"rotation": turned}, {"translation": one.translation + 1e-12},
    ):  # fmt: skip
        different.append(fingerprint(plain, [replace(one, **change), *cameras[1:]], *words))  # type: ignore[arg-type]
    assert len({expected, *different}) == 1 + len(different) == 1 + 4 + 2 + 2 + 2 + 1 + 8


def test_scores_are_kept_when_the_target_cannot_be_met(project: Path, tmp_path: Path) -> None:
    with pytest.raises(TargetError):
        run(project, tmp_path, prune_rate=None, sh_rate=None, max_size=10, effort="fast")
    assert not (tmp_path / "a.fgs").exists()
    assert run(project, tmp_path).scores_reused


@pytest.mark.parametrize("content", [b"", b"ply\nformat", b"PK\x03\x04 not an archive"])
def test_other_files_are_not_overwritten(project: Path, tmp_path: Path, content: bytes) -> None:
    (tmp_path / "s.npz").write_bytes(content)
    with pytest.raises(
        InputError, match=r"s\.npz: expected scores kept by score or by an earlier --score-cache, found"
    ):
        run(project, tmp_path)
    assert (tmp_path / "s.npz").read_bytes() == content and not (tmp_path / "a.fgs").exists()


def test_plain_scores_are_no_cache(project: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "s.npz", scores=np.zeros(400))
    with pytest.raises(InputError, match="something else"):
        run(project, tmp_path)


def test_nothing_to_keep(project: Path, tmp_path: Path) -> None:
    result = run(project, tmp_path, prune_rate=0.0, sh_rate=0.0)
    assert result.score_cache is None and not (tmp_path / "s.npz").exists()
    with pytest.raises(InputError, match="--score 'mine.npy': expected one of gs, meson"):
        CompressOptions(method="paper", score="mine.npy")
    with pytest.raises(InputError, match="--score-cache belongs to --method paper"):
        CompressOptions(method="best", score_cache="s.npz")
