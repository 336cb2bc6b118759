"""Guesses how far planes are from a target for quality, from their mean loss."""

from __future__ import annotations

import math
from typing import Protocol

from flexgs_edge.goals.promise import bounds_ssim, mean_alone, means
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.methods.best.selection import Selection
from flexgs_edge.methods.best.snapshot import Snapshot
from flexgs_edge.scene.source import Planes

LEAD_FROM = 1.0
"""Rounds of pruning measure SSIM once, as soon as the log of the loss is this near to their end: docs/results/tuning.md#lead"""
PRUNED_PART = 0.45
"""Share of the allowed loss that pruning alone uses up when a candidate meets the target: docs/results/tuning.md#pruned_part"""


class Measure(Protocol):
    """Quality of planes ([width, n] f32 by field). With `estimate` it is a good guess that takes less time."""

    def __call__(self, planes: Planes, estimate: bool = False) -> Measurement: ...


class Guess:
    """Guesses the excess of planes.

    `measure`: quality of planes. `lead`: by how much SSIM is nearer to its bound than the mean, as a log. That changes
    little with compression or by a refit, so it is not measured each time: docs/results/tuning.md#lead
    """

    def __init__(self, measure: Measure) -> None:
        self._measure, self.lead = measure, 0.0

    def __call__(self, planes: Planes, target: Target) -> float:
        """Excess of planes by a target for quality, from the mean loss and the lead."""
        return mean_alone(target).excess(0, self._measure(planes, estimate=True)) + self.lead

    def learn(self, planes: Planes, target: Target) -> None:
        """Measure the lead, if SSIM is bounded."""
        if bounds_ssim(target):
            quality = self._measure(planes)
            self.lead = max(means(target).excess(0, quality) - mean_alone(target).excess(0, quality), 0.0)

    def prune(self, selection: Selection, target: Target, part: float, times: float = 1.0) -> None:
        """Prune until pruning alone loses `part` of what the target allows, or `times` the rows are left that a size allows."""
        rounds, limit, end = selection.rounds, target.limit_bytes, math.log(part)

        def enough(last: Snapshot) -> bool:
            if limit is not None:
                return last.count * selection.bits.base / 8 <= times * limit
            if len(rounds.snapshots) == 1:
                return False
            excess = self(last.planes, target)
            if self.lead == 0.0 and excess >= end - LEAD_FROM:
                self.learn(last.planes, target)
                excess += self.lead
            return excess >= end

        selection.prune(enough)
