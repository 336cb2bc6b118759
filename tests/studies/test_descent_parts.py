"""Descents without one of their parts: what a descent is then asked for."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from flexgs_edge.methods.best import effort, grid_maker
from flexgs_edge.methods.best.refit.distil import STRUCTURE, Schedule, distil
from flexgs_edge.progress import SILENT
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.studies.rate import descent_parts
from flexgs_edge.studies.rate.ablations import WHOLE, Variant, parts_of
from flexgs_edge.studies.rate.points import best_points
from flexgs_edge.studies.study_scene import StudyScene, open_study_scene
from tiny_project import COUNT, make_project

pytestmark = pytest.mark.usefixtures("short_searches")

RATIO = 3.0
VARIANTS = {variant.name: variant for variant in parts_of(np.arange(COUNT), 3, descends=True)[5:]}


@pytest.fixture(scope="module")
def studied(short_searches: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudyScene]:
    place = make_project(tmp_path_factory.mktemp("parts") / "cloud")
    options = CompressOptions(method="best", holdout=4)
    with open_study_scene(place / "point_cloud.ply", "cloud", options, SILENT) as opened:
        yield opened


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Schedule, bool, float]]:
    """Of each descent: its schedule, whether it has a grid, and the weight of SSIM."""
    found: list[tuple[Schedule, bool, float]] = []

    def watched(*words: Any, structure: float = STRUCTURE, **more: Any) -> dict[str, np.ndarray]:
        schedule, *steps = words[3:]
        found.append((schedule, bool(steps) and steps[0] is not None, structure))
        return distil(*words, structure=structure, **more)

    monkeypatch.setattr(effort, "LEAST_STEPS", 60)
    for module in (grid_maker, descent_parts):
        monkeypatch.setattr(module, "distil", watched)
    return found


def test_each_part_is_gone_and_the_others_stay(studied: StudyScene, asked: list[tuple[Schedule, bool, float]]) -> None:
    def lacks(variant: Variant) -> set[str]:
        asked.clear()
        (point,) = best_points(studied, variant, "max", [RATIO]).points
        sizes.append(point.size)
        if not asked:
            return {"no descents"}
        on_grid = [schedule for schedule, grid, _ in asked if grid]
        assert on_grid
        tests = {
            "none between": all(grid for _, grid, _ in asked),
            "no prices": all(schedule.multiplier == 0 for schedule in on_grid),
            "no SSIM": all(weight == 0 for _, _, weight in asked),
            "no grid": all(len(schedule.parts(True)[0]) == schedule.iterations for schedule in on_grid),
            "no mean": all(schedule.course.mean_views == 0 for schedule in on_grid),
        }
        return {name for name, gone in tests.items() if gone}

    sizes: list[int] = []
    assert lacks(WHOLE) == set()
    for name, variant in VARIANTS.items():
        assert lacks(variant) == {name}
    assert len(set(sizes)) == len(sizes)


def test_only_searches_that_descend_lack_parts_of_it() -> None:
    assert list(VARIANTS) == ["no descents", *(name for name, *_ in descent_parts.DESCENT_PARTS)]
    assert not set(VARIANTS) & {variant.name for variant in parts_of(np.arange(COUNT), 3, descends=False)}
