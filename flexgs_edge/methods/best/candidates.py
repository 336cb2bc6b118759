"""What a search has seen: whole results, which of them is better, and where the next one should be looked for."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from flexgs_edge.goals.line import NEAREST, next_point
from flexgs_edge.goals.target import Measurement, Target

Product = TypeVar("Product")
"""What a step makes: a grid, or a finished file."""

SLOPE = 0.7
"""Slope of the log of the drop over the log of the multiplier before two points are measured:
docs/results/tuning.md#slope"""
SIZE_SLOPE = -0.45
"""The same for the log of the size."""
LARGEST_STRIDE = 1.2
"""Largest change of the log of the multiplier between two steps."""


@dataclass(frozen=True)
class Candidate:
    """One whole result that the search looked at.

    Parameters
    ----------
    multiplier : float
        Squared error that a bit is worth.
    count, sh_count : int
        Gaussians kept, and those with SH.
    size : int
        Bytes of the file.
    measurement : Measurement
    excess : float
        By how much the target was missed; zero or less holds.
    seconds : float
    left_out : int
        Gaussians that no scored pose sees and that would have made all others coarser (see `Kept`).
    """

    multiplier: float
    count: int
    sh_count: int
    size: int
    measurement: Measurement
    excess: float
    seconds: float
    left_out: int = 0

    @property
    def holds(self) -> bool:
        """The target holds here."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class RateResult(Generic[Product]):
    """The answer of a search: what to write and the way to it."""

    product: Product
    chosen: Candidate
    reached: bool
    steps: tuple[Candidate, ...]


def misses(steps: Sequence[Candidate]) -> int:
    """How many of the last results missed the target."""
    return next((count for count, step in enumerate(reversed(steps)) if step.holds), len(steps))


def bounds(steps: Sequence[Candidate], by_size: bool) -> tuple[float, float]:
    """Logs of the multipliers between which the answer lies, away from both ends; infinite where none is known.

    One end is the farthest result that holds, the other the nearest miss beyond it. Misses before it are void: refits go on
    from each other, and had not come as far then.
    """
    sign = -1.0 if by_size else 1.0
    low = max((sign * math.log(s.multiplier) for s in steps if s.holds), default=-math.inf)
    high = min((m for s in steps if not s.holds and (m := sign * math.log(s.multiplier)) > low), default=math.inf)
    away = NEAREST * (high - low) if math.isfinite(high - low) else 0.0
    ends = sign * (low + away), sign * (high - away)
    return min(ends), max(ends)


def next_multiplier(steps: Sequence[Candidate], target: Target) -> float:
    """Where the excess is expected to be just below zero, in the log of the multiplier."""
    slope = SIZE_SLOPE if target.limit_bytes is not None else SLOPE
    return math.exp(next_point([(math.log(s.multiplier), s.excess) for s in steps], slope, LARGEST_STRIDE))
