"""Search one number, such as the prune rate, with few and costly measurements.

A measurement takes seconds, and sizes are known only from finished files. We look for the place on a line where the
excess turns positive. The excess is assumed to rise along the line, not quite smoothly. The answer is always a measured
point.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from flexgs_edge.goals.steps import MAX_PRUNE, Step
from flexgs_edge.goals.target import Target

AIM = -0.01
"""Excess that new points aim at: a little below the target."""
NEAREST = 0.1
"""A new point keeps this share of the interval between its neighbours away from both, since curves are not quite
smooth."""
CLOSE = 0.03
"""The search stops at a point whose excess (log of loss or size over its limit) is below the target by at most this."""
LINE_STEPS = {"fast": 4, "balanced": 6, "max": 10}
"""Measured points on a line for each `--effort`, beyond those that are known already."""
START = 300
"""Prune rate, in thousandths, at which a search for a quality starts."""
SLOPE = 5.0
"""Excess of a quality (log of the loss over its limit) per unit of the prune rate:
docs/results/tuning.md#prior_slopes"""


def next_point(points: Iterable[tuple[float, float]], slope: float, stride: float, least: float = 0.2) -> float:
    """Position where the excess should be just below zero: false position, kept away from measured points.

    Parameters
    ----------
    points : iterable of tuple
        (position, excess) of the measured points, at least one.
    slope : float
        Excess per position, used before two points are measured. Its sign must be right.
    stride : float
        Largest move beyond all points; twice that once a slope has been measured.
    least : float
        A measured slope counts as at least this share of `slope`. Points that differ by chance have no slope of their own.

    >>> round(next_point([(0.0, -1.0), (1.0, 1.0)], 2.0, 1.0), 3)
    0.495
    """
    points = sorted(points)
    if slope < 0:
        points.reverse()
    # Sorted by rising excess, these are the last point that holds and the first one that misses.
    first_miss = next((i for i, (_, excess) in enumerate(points) if excess > 0), len(points))
    if 0 < first_miss < len(points):
        (low, below), (high, above) = points[first_miss - 1], points[first_miss]
        part = (AIM - below) / (above - below)
        return low + (high - low) * min(max(part, NEAREST), 1 - NEAREST)
    edge, excess = points[-1] if first_miss else points[0]
    if len(points) > 1:
        # The slope between the two points nearest to the target, kept within bounds.
        (low, below), (high, above) = points[-2:] if first_miss else points[:2]
        measured = (above - below) / (high - low) if high != low else slope
        slope *= min(max(measured / slope, least), 3.0)
        stride *= 2
    return edge + max(-stride, min(stride, (AIM - excess) / slope))


def search_line(
    measure: Callable[[int], Step], target: Target, start: int, steps: int, known: Sequence[Step] = ()
) -> list[Step]:
    """Measure up to `steps` points on a line of prune rates; returns all points of the line, `known` first.

    For a quality, the answer is the highest rate that holds; for a size, the lowest.

    Parameters
    ----------
    measure : callable
        Measures the step at a prune rate in thousandths, 0 to `MAX_PRUNE`.
    start : int
        First rate to measure, unless `known` has points.
    known : sequence of Step
        Points of this line that are measured already.
    """
    by_size = target.limit_bytes is not None
    gentler = 1 if by_size else -1  # direction, in thousandths, towards points that hold
    found = {step.choice.prune: step for step in known}
    rate = start
    for count in range(steps):
        if found:
            if any(-CLOSE < step.excess <= 0 for step in found.values()):
                break
            points = weighed([(_position(step.choice.prune, by_size), step.excess) for step in found.values()])
            rate = _rate(next_point(points, -1.0 if by_size else SLOPE, 1.2 if by_size else 0.3), by_size)
            if count == steps - 1 and not any(step.holds for step in found.values()):
                # The last step measures the gentlest point for a quality, or the smallest file for a size.
                rate = MAX_PRUNE if by_size else 0
        rate = max(0, min(MAX_PRUNE, rate))
        if rate in found and not found[rate].holds:
            rate = max(0, min(MAX_PRUNE, rate + gentler))
        if rate in found:
            break
        found[rate] = measure(rate)
    return list(found.values())


def weighed(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points for `next_point`; after several on one side, the other side's excess counts half for each beyond the first.

    This is the Illinois rule. The log of a loss is curved, so that plain false position would approach the target
    slowly.

    Parameters
    ----------
    points : sequence of tuple
        (position, excess) in the order in which they were measured, at least one.
    """
    sides = [excess <= 0.0 for _, excess in points]
    streak = next((count for count, side in enumerate(reversed(sides)) if side != sides[-1]), len(sides))
    far = 0.5 ** (streak - 1)
    return [
        (position, excess * (1.0 if side == sides[-1] else far))
        for (position, excess), side in zip(points, sides, strict=True)
    ]


def _position(prune: int, by_size: bool) -> float:
    # Sizes are about proportional to the rows kept, so the log of a size is linear in this position.
    return -math.log(1 - prune / 1000) if by_size else prune / 1000


def _rate(position: float, by_size: bool) -> int:
    """The rate at a position, rounded towards points that hold."""
    return math.ceil(1000 * (1 - math.exp(-max(position, 0.0)))) if by_size else math.floor(1000 * position)
