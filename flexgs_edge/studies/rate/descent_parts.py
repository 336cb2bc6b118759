"""Ablations of descents: searches that replace one part of them and leave the rest as it is."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.refit.distil import Schedule, distil
from flexgs_edge.methods.best.selection import Kept
from flexgs_edge.scene.source import Planes


class NoneBetween(GridMaker):
    """A search without descents between rounds of pruning."""

    def __init__(self, *words: Any, **more: Any) -> None:
        super().__init__(*words, **more)
        self._interleaved = 0


class NoPrices(GridMaker):
    """A search in whose descents bits cost nothing."""

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        return super()._distil(kept, replace(schedule, multiplier=0.0), step_sizes)


class NoStructure(GridMaker):
    """A search whose descents see squared errors alone, without SSIM."""

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        return distil(kept.planes, kept.degrees, self.rounds.original, schedule, step_sizes, structure=0.0)


class RoundedAtTheEnd(GridMaker):
    """A search whose descents draw the values themselves to the end, and never those on the grid."""

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        return super()._distil(kept, replace(schedule, on_grid=1.0, holding=1.0), step_sizes)


class NoMean(GridMaker):
    """A search whose descents end with their last values, and not with a mean of the last ones."""

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        course = replace(schedule.course, mean_views=0.0)
        return super()._distil(kept, replace(schedule, course=course), step_sizes)


DESCENT_PARTS: tuple[tuple[str, str, type[GridMaker]], ...] = (
    ("none between", "no descents between the rounds of pruning", NoneBetween),
    ("no prices", "bits cost nothing in descents", NoPrices),
    ("no SSIM", "descents see squared errors alone", NoStructure),
    ("no grid", "descents draw values off the grid, which round at the end", RoundedAtTheEnd),
    ("no mean", "descents end with their last values, not with a running mean", NoMean),
)
"""Name in tables, what replaces the part, and the search."""
