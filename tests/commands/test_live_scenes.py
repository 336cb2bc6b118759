"""The live scenes of a report: which scenes a page holds, and how finely the original is coded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.commands import compress as live
from flexgs_edge.commands.compress import compress, fine_steps, live_scenes
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import Run, open_run
from tiny_project import make_project


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene")


@pytest.fixture(scope="module")
def coded(project: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("coded") / "a.fgs"
    compress(project / "point_cloud.ply", place, method="paper", max_drop=3.0, effort="fast", holdout=4)
    return place


@pytest.fixture
def run(project: Path) -> Run[Any]:
    return open_run(project / "point_cloud.ply", ViewOptions())


def test_both_scenes_are_there(run: Run[Any], coded: Path, tmp_path: Path) -> None:
    made = live_scenes(run, coded, 2)
    assert made.compressed == coded.read_bytes() and made.original is not None and made.note == ""
    assert made.config["first"] == 2 and len(made.config["poses"]) == len(run.seen.cameras)
    assert "use strict" in made.script[:40]


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("SCENE_MOST", 0, "The file, "),
        ("ROWS_MOST", 0, "The original is too large"),
        ("ROW_BYTES", 1 << 60, "The memory"),
    ],
)
def test_what_is_too_large_is_said(
    run: Run[Any], coded: Path, monkeypatch: pytest.MonkeyPatch, name: str, value: int, words: str
) -> None:
    monkeypatch.setattr(live, name, value)
    run = replace(run, budget=MemoryBudget.from_limit(1 << 30))
    made = live_scenes(run, coded, 0)
    assert made.original is None and made.note.startswith(words)
    assert (made.compressed is None) == (made.script == "") == (name == "SCENE_MOST")


def test_an_original_that_becomes_too_large(run: Run[Any], coded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "SCENE_MOST", coded.stat().st_size)
    assert live_scenes(run, coded, 0).note == "The original is too large for this page"


def test_positions_are_finer_than_small_gaussians_and_fit_their_bits() -> None:
    means, scales = np.zeros((3, 100), np.float32), np.full((3, 100), np.log(0.8), np.float32)
    assert fine_steps(means, scales, 2).position == pytest.approx(0.05)
    means[1, 7] = 1e6
    far = fine_steps(means, scales, 2)  # a far one is contracted, and coarsens no other
    assert far.position == pytest.approx(0.05) and far.contraction is not None
    assert len(fine_steps(means, scales, 2).sh) == 2
