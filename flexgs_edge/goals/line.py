"""One number, few and costly measurements: where along a line the excess is about to turn positive.

Used where a step takes seconds and sizes are only known from finished files. The excess is taken to rise along the line, not
quite smoothly; every answer is a point that was itself measured.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence

from flexgs_edge.goals.steps import MAX_PRUNE, Step
from flexgs_edge.goals.target import Target

AIM = -0.01
"""Excess that steps aim at."""
NEAREST = 0.1
"""A new step keeps this share of the interval between its neighbours away from both: curves are not quite smooth."""
CLOSE = 0.03
"""Excess (log of loss or size over limit) that counts as close enough below the target."""
LINE_STEPS = {"fast": 4, "balanced": 6, "thorough": 10}
"""Measured points on a line at each `--effort`, beyond those that are there already."""
START = 300
"""Prune rate, in thousandths, where a search for a quality starts."""
SLOPE = 5.0
"""Excess of a quality (log of the loss over its limit) per unit of the prune rate:
docs/results/tuning.md#prior_slopes"""


def next_point(points: Iterable[tuple[float, float]], slope: float, stride: float) -> float:
    """Where the excess is expected to be just below zero: false position, kept away from points already asked.

    Parameters
    ----------
    points : iterable of tuple
        (position, excess) measured so far, at least one.
    slope : float
        Excess per position, before two points are measured; its sign is known for sure.
    stride : float
        Largest move beyond all points (twice that once a slope has been measured).

    >>> round(next_point([(0.0, -1.0), (1.0, 1.0)], 2.0, 1.0), 3)
    0.495
    """
    points = sorted(points)
    if slope < 0:
        points.reverse()
    # In the order of rising excess: the last point that holds before the first one that misses.
    first_miss = next((i for i, (_, excess) in enumerate(points) if excess > 0), len(points))
    if 0 < first_miss < len(points):
        (low, below), (high, above) = points[first_miss - 1], points[first_miss]
        part = (AIM - below) / (above - below)
        return low + (high - low) * min(max(part, NEAREST), 1 - NEAREST)
    edge, excess = points[-1] if first_miss else points[0]
    if len(points) > 1:
        # The slope between the two points nearest to the target, kept within reason.
        (low, below), (high, above) = points[-2:] if first_miss else points[:2]
        measured = (above - below) / (high - low) if high != low else slope
        slope *= min(max(measured / slope, 0.2), 3.0)
        stride *= 2
    return edge + max(-stride, min(stride, (AIM - excess) / slope))


def search_line(
    measure: Callable[[int], Step], target: Target, start: int, steps: int, known: Sequence[Step] = ()
) -> list[Step]:
    """Measure up to `steps` points of a line of prune rates; all points of the line come back, `known` first.

    For a quality the answer is the highest rate that holds, for a size the lowest.

    Parameters
    ----------
    measure : callable
        The step at a prune rate in thousandths, 0 to `MAX_PRUNE`.
    start : int
        Rate that is measured first, unless `known` has points.
    known : sequence of Step
        Points of this line measured before.
    """
    by_size = target.limit_bytes is not None
    gentler = 1 if by_size else -1  # in thousandths, towards points that hold
    found = {step.choice.prune: step for step in known}
    rate = start
    for count in range(steps):
        if found:
            if any(-CLOSE < step.excess <= 0 for step in found.values()):
                break
            points = [(_position(prune, by_size), excess) for prune, excess in _weighed(list(found.values()))]
            rate = _rate(next_point(points, -1.0 if by_size else SLOPE, 1.2 if by_size else 0.3), by_size)
            if count == steps - 1 and not any(step.holds for step in found.values()):
                # The last chance: the gentlest point of a quality, the smallest file of a size.
                rate = MAX_PRUNE if by_size else 0
        rate = max(0, min(MAX_PRUNE, rate))
        if rate in found and not found[rate].holds:
            rate = max(0, min(MAX_PRUNE, rate + gentler))
        if rate in found:
            break
        found[rate] = measure(rate)
    return list(found.values())


def _weighed(steps: list[Step]) -> list[tuple[int, float]]:
    """(rate, excess) of the steps; after points on one side only, those of the other count half for each (Illinois rule).

    The log of a loss is curved: plain false position creeps towards the target from one side.
    """
    side = steps[-1].holds
    streak = next((i for i, step in enumerate(reversed(steps)) if step.holds != side), len(steps))
    far = 0.5 ** (streak - 1)
    return [(step.choice.prune, step.excess * (1.0 if step.holds == side else far)) for step in steps]


def _position(prune: int, by_size: bool) -> float:
    # Sizes are about proportional to what is kept: their log is linear in this.
    return -math.log(1 - prune / 1000) if by_size else prune / 1000


def _rate(position: float, by_size: bool) -> int:
    """Rounded towards points that hold."""
    return math.ceil(1000 * (1 - math.exp(-max(position, 0.0)))) if by_size else math.floor(1000 * position)
