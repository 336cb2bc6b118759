"""The first error about a memory limit names one that is enough for the whole run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.render import render_views
from flexgs_edge.errors import BudgetError
from flexgs_edge.units import parse_size
from tiny_project import make_project


def named(error: BudgetError) -> int:
    found = re.search(r"use --memory-limit (\d+MiB) or more", str(error))
    assert found, error
    return parse_size(found.group(1))


@pytest.mark.parametrize("words", [{"effort": "fast"}, {"method": "paper", "max_drop": 3.0}], ids=str)
def test_the_first_limit_is_enough(words: dict[str, Any], tmp_path: Path) -> None:
    scene = make_project(tmp_path) / "point_cloud.ply"
    words = {"dry_run": True, "device": "numpy", "best_effort": True, **words}
    with pytest.raises(BudgetError, match="which counts later stages too") as caught:
        compress(scene, None, memory_limit=2**20, **words)
    assert compress(scene, None, memory_limit=named(caught.value), **words).size > 0


def test_that_of_an_evaluation_as_well(tmp_path: Path) -> None:
    scene = make_project(tmp_path) / "point_cloud.ply"
    with pytest.raises(BudgetError, match="the program already holds .* which counts later stages too") as caught:
        evaluate(scene, scene, memory_limit=2**20, device="numpy")
    evaluate(scene, scene, memory_limit=named(caught.value), device="numpy")


def test_that_of_drawing_as_well(tmp_path: Path) -> None:
    scene = make_project(tmp_path) / "point_cloud.ply"

    def run(limit: int) -> None:
        render_views(scene, tmp_path / "views", force=True, device="numpy", memory_limit=limit)

    with pytest.raises(BudgetError, match="which counts later stages too") as caught:
        run(2**20)
    run(named(caught.value))
