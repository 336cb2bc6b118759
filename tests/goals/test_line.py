"""The next point of a search along one number."""

from __future__ import annotations

import pytest

from flexgs_edge.methods.best.search import AIM, next_point


def test_the_slope_is_that_between_the_nearest_points() -> None:
    """On both sides of the target, whatever lies farther away, and within bounds of what was expected."""
    assert next_point([(0.0, -9.0), (1.0, -3.0), (4.0, -1.5)], 1.0, 10.0) == pytest.approx(4 + (AIM + 1.5) / 0.5)
    assert next_point([(0.0, 1.5), (3.0, 3.0), (4.0, 9.0)], 1.0, 10.0) == pytest.approx((AIM - 1.5) / 0.5)
    assert next_point([(0.0, -9.0), (1.0, -2.0)], 1.0, 10.0) == pytest.approx(1 + (AIM + 2) / 3)


def test_next_points() -> None:
    # One point: by the slope given, no farther than the stride.
    assert next_point([(0.0, -0.5)], 5.0, 10.0) == pytest.approx(0.098)
    assert next_point([(0.0, -50.0)], 5.0, 1.0) == 1.0
    assert next_point([(0.0, 0.5)], -1.0, 10.0) == pytest.approx(0.51)
    # Between a point that holds and one that misses: false position, away from both.
    assert next_point([(2.0, 3.0), (1.0, -1.0)], 1.0, 1.0) == pytest.approx(1 + 0.99 / 4)
    assert next_point([(1.0, -0.001), (2.0, 3.0)], 1.0, 1.0) == pytest.approx(1.1)
    # Two points on one side: by their own slope, but by no less than a share of the slope given.
    assert next_point([(0.0, -0.5), (1.0, -0.49)], 1.0, 10.0) == pytest.approx(1 + 0.48 / 0.5)
    assert next_point([(0.0, -0.5), (1.0, -0.6)], 1.0, 10.0, 0.5) == pytest.approx(1 + 0.59 / 0.5)
