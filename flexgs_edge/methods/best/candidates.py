"""The candidates that a search has seen, and the multiplier at which it should look next.

A candidate is a finished result: refitted, coded and measured.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from flexgs_edge.goals.line import NEAREST, next_point, weighed
from flexgs_edge.goals.target import Measurement, Target

Product = TypeVar("Product")
"""Type of the product of a candidate: a grid, or a finished file."""

SLOPE = 0.7
"""Slope of the log of the drop over the log of the multiplier before two points are measured:
docs/results/tuning.md#slope"""
SIZE_SLOPE = -0.45
"""Slope of the log of the size over the log of the multiplier."""
LARGEST_STRIDE = 1.2
"""Largest change of the log of the multiplier between two candidates."""
LEAST_SLOPE = 0.5
"""Least share of the expected slope that we take from candidates that all hold. They may differ by chance, and one that goes far
beyond the target is lost: docs/results/tuning.md#least_slope"""


@dataclass(frozen=True)
class Candidate:
    """A finished result that the search made and measured.

    Parameters
    ----------
    multiplier : float
        Squared error that a bit is worth.
    count, sh_count : int
        Gaussians kept, and those with SH.
    size : int
        Bytes of the file.
    measurement : Measurement
        Quality of the result.
    excess : float
        Log of loss (or size) over its limit: the target holds at zero or less.
    seconds : float
        Time that making and measuring took.
    left_out : int
        Gaussians that no scored pose sees and that were left out because the grid would be coarser with them.
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
        """Whether this candidate meets the target."""
        return self.excess <= 0.0


@dataclass(frozen=True)
class RateResult(Generic[Product]):
    """The answer of a search.

    Parameters
    ----------
    product : Product
        A grid, or a finished file.
    chosen : Candidate
        The best candidate, which `product` belongs to.
    reached : bool
        Whether it meets the target.
    steps : tuple of Candidate
        All candidates in the order of the search.
    """

    product: Product
    chosen: Candidate
    reached: bool
    steps: tuple[Candidate, ...]


def misses(steps: Sequence[Candidate]) -> int:
    """How many candidates in a row missed the target, up to the last one."""
    return next((count for count, step in enumerate(reversed(steps)) if step.holds), len(steps))


def bounds(steps: Sequence[Candidate], by_size: bool) -> tuple[float, float]:
    """Logs of the two multipliers between which the answer lies, a little inside of both; infinite where none is known.

    One end is the farthest candidate that holds, the other the nearest miss beyond it. Other misses do not count: each
    refit goes on from the last one, so early misses were refitted less.
    """
    sign = -1.0 if by_size else 1.0
    low = max((sign * math.log(s.multiplier) for s in steps if s.holds), default=-math.inf)
    high = min((m for s in steps if not s.holds and (m := sign * math.log(s.multiplier)) > low), default=math.inf)
    away = NEAREST * (high - low) if math.isfinite(high - low) else 0.0
    ends = sign * (low + away), sign * (high - away)
    return min(ends), max(ends)


def next_multiplier(steps: Sequence[Candidate], target: Target) -> float:
    """The multiplier at which the excess should be just below zero."""
    slope = SIZE_SLOPE if target.limit_bytes is not None else SLOPE
    points = weighed([(math.log(s.multiplier), s.excess) for s in steps])
    if all(step.holds for step in steps):
        return math.exp(next_point(points, slope, LARGEST_STRIDE, LEAST_SLOPE))
    return math.exp(next_point(points, slope, LARGEST_STRIDE))
