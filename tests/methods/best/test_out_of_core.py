"""Scenes that do not fit into memory: the same pictures, sums and bytes as those that do, also after a kill."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.storage import ScratchStorage
from flexgs_edge.methods.best import effort, grid_maker
from flexgs_edge.methods.best import method as best_method
from flexgs_edge.methods.best.effort import EFFORTS
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.refit.finetune import Schedule
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.references import Original
from synthetic import random_scene
from tiny_project import make_project, write_cameras

TINY: dict[str, Any] = {"effort": "fast", "holdout": 4, "min_fidelity": 35.0, "best_effort": True, "promise": "mean"}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene", photos=False)


@pytest.fixture(scope="module")
def expected(project: Path) -> bytes:
    compress(project / "point_cloud.ply", project / "plain.fgs", layers=2, **TINY)
    return (project / "plain.fgs").read_bytes()


@pytest.fixture
def spilled(compact: None, monkeypatch: pytest.MonkeyPatch) -> list[ScratchStorage]:
    """Every scene goes to scratch files, however small."""
    storages: list[ScratchStorage] = []

    def choose(run: Any, renderer: Any, cameras: Any, folder: Path) -> ScratchStorage:
        storages.append(ScratchStorage(folder, least=1))
        return storages[-1]

    monkeypatch.setattr(best_method, "choose_storage", choose)
    return storages


def test_the_bytes_are_those_of_a_run_in_memory(
    project: Path, expected: bytes, spilled: list[ScratchStorage], tmp_path: Path
) -> None:
    result = compress(project / "point_cloud.ply", tmp_path / "a.fgs", layers=2, **TINY)
    assert (tmp_path / "a.fgs").read_bytes() == expected
    assert result.run.scratch == spilled[0].peak > 0 and result.run.peak_anonymous
    assert os.listdir(tmp_path) == ["a.fgs"]


class Stop(BaseException):
    """What ends a run in the middle, as a kill does."""


def test_a_run_goes_on_from_its_last_round(
    project: Path, expected: bytes, spilled: list[ScratchStorage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = {**TINY, "layers": 2, "resume": True, "scratch": str(tmp_path / "kept")}
    (tmp_path / "kept").mkdir()
    drawn = []
    both = Renderer.residual_and_removal_sums

    def stop_after(most: int) -> None:
        def draw(self: Renderer, *arguments: Any) -> Any:
            if len(drawn) == most:
                raise Stop
            drawn.append(1)
            return both(self, *arguments)

        drawn.clear()
        monkeypatch.setattr(Renderer, "residual_and_removal_sums", draw)

    for views in (0, 9):  # in the first round, and in a later one
        stop_after(views)
        with pytest.raises(Stop):
            compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
        assert not (tmp_path / "a.fgs").exists()
    (kept,) = (tmp_path / "kept").iterdir()
    rounds = len(list(kept.glob("round-*/done")))
    assert rounds >= 2
    # Other poses, a descent to follow, which wants views from between them, or descents between the rounds, whose place depends
    # on the target: not what was kept.
    monkeypatch.setitem(EFFORTS, "balanced", replace(EFFORTS["balanced"], descends=0))
    most = {"effort": "balanced", "layers": 1}
    changes = ({"holdout": 3}, {"distil": 10, "layers": 1}, most, {**most, "min_fidelity": 36.0})
    for folders, change in enumerate(changes, start=2):
        stop_after(0)
        with pytest.raises(Stop):
            compress(project / "point_cloud.ply", tmp_path / "b.fgs", **{**words, **change})
        assert len(list((tmp_path / "kept").iterdir())) == folders
    stop_after(10**6)
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
    resumed = len(drawn)
    assert (tmp_path / "a.fgs").read_bytes() == expected and not kept.exists()
    drawn.clear()
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", **{**words, "force": True})
    assert (tmp_path / "a.fgs").read_bytes() == expected and len(drawn) > resumed


def test_descents_between_the_rounds_are_not_done_again(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps = 100
    monkeypatch.setattr(effort, "LEAST_STEPS", steps)
    # Pruning stops early, so that fine-tuning leaves less than the target allows.
    monkeypatch.setitem(EFFORTS, "balanced", replace(EFFORTS["balanced"], interleaved=2, descends=0, finetuned=3.0))
    words: dict[str, Any] = {**TINY, "effort": "balanced"}
    compress(project / "point_cloud.ply", tmp_path / "a.fgs", **words)
    words = {**words, "resume": True, "scratch": str(tmp_path)}
    moved: list[int] = []
    whole, descend = GridMaker.make, grid_maker.finetune

    def finetune(planes: Any, degrees: Any, original: Original, schedule: Schedule, *more: Any, **words: Any) -> Any:
        moved.append(schedule.iterations)
        return descend(planes, degrees, original, schedule, *more, **words)

    def stop(*_: Any) -> Any:
        raise Stop

    monkeypatch.setattr(grid_maker, "finetune", finetune)
    monkeypatch.setattr(GridMaker, "make", stop)
    with pytest.raises(Stop):
        compress(project / "point_cloud.ply", tmp_path / "b.fgs", **words)
    between = [steps // 2] * 2
    assert moved == between
    monkeypatch.setattr(GridMaker, "make", whole)
    compress(project / "point_cloud.ply", tmp_path / "b.fgs", **words)
    # Not those of the rounds again, but candidates.
    assert set(moved[len(between) :]) == {steps}
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()


def test_a_full_disk_leaves_nothing_behind(
    project: Path, spilled: list[ScratchStorage], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reserve = os.posix_fallocate
    calls = []

    def full(descriptor: int, offset: int, size: int) -> None:
        calls.append(size)
        if len(calls) > 40:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        reserve(descriptor, offset, size)

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(BudgetError, match="the disk is full"):
        compress(project / "point_cloud.ply", tmp_path / "a.fgs", **TINY)
    assert not os.listdir(tmp_path)


def test_other_formats_stay_in_memory(project: Path, tmp_path: Path) -> None:
    for words in ({"resume": True}, {"scratch": str(tmp_path)}):
        with pytest.raises(InputError, match=r"\.fgs files alone"):
            compress(project / "point_cloud.ply", tmp_path / "a.spz", **{**TINY, **words})


def run(folder: Path, *words: str, seconds: float | None = None) -> subprocess.CompletedProcess[str] | None:
    """`compress` in a process of its own, killed after some seconds (then None)."""
    command = [
        sys.executable,
        "-m",
        "flexgs_edge",
        "compress",
        str(folder / "point_cloud.ply"),
        "-o",
        str(folder / "a.fgs"),
    ]
    command += ["--effort", "fast", "--min-fidelity", "38", "--best-effort", *words]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    try:
        return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=seconds, check=False)
    except subprocess.TimeoutExpired:  # subprocess kills it then
        return None


def test_kills_lose_no_bytes(tmp_path: Path) -> None:
    """Killed twice at any moment, and resumed (what lies in scratch files alone is gone with the process: test_scratch.py)."""
    write_ply(tmp_path / "point_cloud.ply", random_scene(3000, 8, 3, size=-4.0))
    write_cameras(tmp_path / "cameras.json")
    started = time.perf_counter()
    done = run(tmp_path)
    took = time.perf_counter() - started
    assert done is not None and done.returncode == 0, done
    expected = (tmp_path / "a.fgs").read_bytes()
    (tmp_path / "a.fgs").unlink()
    for share in (0.5, 0.8):
        if run(tmp_path, "--resume", seconds=share * took) is None:
            # Killed at its very end, it had given the file its name.
            assert not (tmp_path / "a.fgs").exists() or (tmp_path / "a.fgs").read_bytes() == expected
            others = set(os.listdir(tmp_path)) - {"a.fgs"}
            assert all(name.startswith((".flexgs-", "point", "cameras")) for name in others)
            (tmp_path / "a.fgs").unlink(missing_ok=True)
    done = run(tmp_path, "--resume", "-f")
    assert done is not None and done.returncode == 0, done
    assert (tmp_path / "a.fgs").read_bytes() == expected
    assert sorted(os.listdir(tmp_path)) == ["a.fgs", "cameras.json", "point_cloud.ply"]
