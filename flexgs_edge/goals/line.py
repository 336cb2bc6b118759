"""The next point of a search along one number, whose measurements are few and costly: false position."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

AIM = -0.01
"""Excess that new points aim at: a little below the target."""
NEAREST = 0.1
"""A new point keeps this share of the interval between its neighbours away from both, since curves are not quite
smooth."""


def next_point(points: Iterable[tuple[float, float]], slope: float, stride: float, least: float = 0.2) -> float:
    """Position where the excess should be just below zero: false position, kept away from measured points.

    `points`: (position, excess) of the measured points, at least one. `slope`: excess per position, used before two
    points are measured. Its sign must be right. `stride`: largest move beyond all points; twice that once a slope has
    been measured. `least`: a measured slope counts as at least this share of `slope`. Points that differ by chance have
    no slope of their own.

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


def weighed(points: Sequence[tuple[float, float]]) -> list[tuple[float, float]]:
    """The points for `next_point`; after several on one side, the other side's excess counts half for each beyond the first.

    This is the Illinois rule. The log of a loss is curved, so that plain false position would approach the target
    slowly.
    """
    sides = [excess <= 0.0 for _, excess in points]
    streak = next((count for count, side in enumerate(reversed(sides)) if side != sides[-1]), len(sides))
    far = 0.5 ** (streak - 1)
    return [
        (position, excess * (1.0 if side == sides[-1] else far))
        for (position, excess), side in zip(points, sides, strict=True)
    ]
