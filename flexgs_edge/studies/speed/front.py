"""The Pareto front of points with a cost and a worth."""

from __future__ import annotations

from collections.abc import Sequence


def front(costs: Sequence[float], worths: Sequence[float]) -> list[bool]:
    """For each point, whether it is on the front: no other, different point costs at most as much and is worth at least as much.

    >>> front([1.0, 2.0, 3.0, 3.0], [5.0, 4.0, 6.0, 6.0])
    [True, False, True, True]
    """
    points = list(zip(costs, worths))
    return [not any(c <= cost and w >= worth and (c, w) != (cost, worth) for c, w in points) for cost, worth in points]
