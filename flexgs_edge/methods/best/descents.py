"""How long the descents of a search are, how fast they go, and how much of a loss they are expected to mend."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flexgs_edge.methods.best.refit.distil import LAST, LONG, SHORT, Schedule, share_of_lead

DISTILLED, DISTILLED_POWER = 0.46, -0.2
"""Expected loss after a descent of one step for each scored pose, divided by the loss before it, until a candidate tells; and
the power by which it changes with the steps: docs/results/tuning.md#distilled"""
BEHIND_SHORT, BEHIND_LONG = 0.03, 0.02
"""Log of the loss after a first candidate's descent, `SHORT` or `LONG`, over the middle of what the last descent between rounds
left and of the probe: docs/results/tuning.md#distilled"""
BEHIND_LED = -0.09
"""What a full lead of SSIM adds to `BEHIND_SHORT`, as descents then weigh structure more: docs/results/tuning.md#behind_led"""
FULL_PASSES = 10
"""Longest descent at full rates, in steps for each scored pose. Rates fall with the root of a longer one, and a shorter one
goes the course `SHORT`: docs/results/tuning.md#full_passes"""
FULL_RATES, LEAST_RATE = 41.0, 0.25
"""Fidelity in dB up to which a descent goes at full rates, and the least share of these rates: see `rate_from`."""
PRUNED_DISTILLED = 1.6
"""`PRUNED_PART` if a descent follows. It is above 1: a descent wins back more than pruning lost beyond the target."""
INTERLEAVE_TO, MOST_LEFT = 0.8, 0.9
"""The first candidate comes once two descents in a row leave more than the first share of the loss that the target allows. One
that leaves more than the second does not count: docs/results/tuning.md#interleaved"""
MOST_FIT, LEAST_FIT, FIT_DESCENTS = 1.6, 0.8, 7
"""With a target for the size, pruning stops for the first descent at so many times the Gaussians that fit, for the last one at so
many; and most descents: docs/results/tuning.md#interleaved"""
INTERLEAVED_SHARE, INTERLEAVED_LAST = 0.5, 0.2
"""Steps of a descent between rounds, as a share of those of the descent to a candidate, and its last rates over its first:
docs/results/tuning.md#interleaved"""


def fits(most: int) -> list[float]:
    """At how many times the Gaussians that a size allows pruning stops for each of at most so many descents."""
    count = min(most, FIT_DESCENTS)
    return [MOST_FIT * (LEAST_FIT / MOST_FIT) ** (k / max(count - 1, 1)) for k in range(count)]


def rate_from(fidelity: float | None) -> float:
    """Share of the full rates for a descent that starts at `fidelity` dB; it follows the root of the mean squared error.

    With little error left, full steps would break more than they repair: docs/results/tuning.md#rate_from
    """
    return 1.0 if fidelity is None else max(min(1.0, 10 ** ((FULL_RATES - fidelity) / 20)), LEAST_RATE)


@dataclass(frozen=True)
class Descents:
    """The descents of a search."""

    steps: int  # of the descent to a candidate; 0 for none
    poses: int  # scored poses
    lead: float = 0.0  # by how much SSIM is nearer to its bound than the mean, as for `structure_of`

    @property
    def passes(self) -> float:
        """Steps of the descent to a candidate for each scored pose."""
        return self.steps / self.poses

    def schedule(self, share: float, fidelity: float | None, last: float = LAST, multiplier: float = 0.0) -> Schedule:
        """A descent with `share` of a candidate's steps, from planes of this fidelity."""
        rate = min(math.sqrt(FULL_PASSES / self.passes), 1.0) * rate_from(fidelity)
        course = LONG if self._long else SHORT
        return Schedule(math.ceil(share * self.steps), rate, last, multiplier=multiplier, course=course)

    def after(self, excess: float, left: float | None = None) -> float:
        """Expected excess after a first candidate's descent, from that before it, and from that which the descent before left."""
        if left is None:
            return excess + math.log(DISTILLED * math.pow(max(self.passes, 1.0), DISTILLED_POWER))
        behind = BEHIND_LONG if self._long else BEHIND_SHORT + BEHIND_LED * share_of_lead(self.lead)
        return (left + excess) / 2 + behind

    @property
    def _long(self) -> bool:
        return self.passes >= FULL_PASSES
