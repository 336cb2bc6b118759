"""The search along one line of prune rates, over made-up files."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.line import AIM, CLOSE, LINE_STEPS, next_point, search_line
from flexgs_edge.goals.steps import MAX_PRUNE, Step, better
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, Target


class Files:
    """A line whose drop grows as a power of e, with bytes in proportion to what is kept; counts what it is asked."""

    def __init__(self, target: Target, drop: Callable[[float], float], whole: int = 1_000_000) -> None:
        self.target, self.drop, self.whole = target, drop, whole
        self.asked: list[int] = []

    def measure(self, prune: int) -> Step:
        self.asked.append(prune)
        size = 500 + self.whole * (1000 - prune) // 1000
        found = Measurement(self.drop(prune / 1000), None, 0.0)
        return Step(Choice(prune, 0), size, found, self.target.excess(size, found), "line", 0.0)

    def search(self, start: int = 300, steps: int = 10) -> Step:
        points = search_line(self.measure, self.target, start, steps)
        assert [step.choice.prune for step in points] == self.asked and len(self.asked) <= steps
        answer = points[0]
        for step in points[1:]:
            answer = step if better(step, answer, self.target) else answer
        return answer


def test_the_slope_is_that_between_the_nearest_points() -> None:
    """On both sides of the target, whatever lies farther away, and within bounds of what was expected."""
    assert next_point([(0.0, -9.0), (1.0, -3.0), (4.0, -1.5)], 1.0, 10.0) == pytest.approx(4 + (AIM + 1.5) / 0.5)
    assert next_point([(0.0, 1.5), (3.0, 3.0), (4.0, 9.0)], 1.0, 10.0) == pytest.approx((AIM - 1.5) / 0.5)
    assert next_point([(0.0, -9.0), (1.0, -2.0)], 1.0, 10.0) == pytest.approx(1 + (AIM + 2) / 3)


@settings(deadline=None)
@given(st.floats(0.001, 0.9), st.floats(2.0, 9.0))
def test_a_quality_is_met_closely_and_never_missed(least: float, slope: float) -> None:
    files = Files(MaxDrop(1.0), lambda p: least * math.exp(slope * p))
    answer = files.search()
    assert answer.holds
    best = min(math.log(1 / least) / slope, MAX_PRUNE / 1000)
    assert answer.choice.prune / 1000 >= best - 0.05, (answer, best)
    assert len(set(files.asked)) == len(files.asked)


@settings(deadline=None)
@given(st.integers(20_000, 1_400_000), st.integers(0, MAX_PRUNE))
def test_a_size_is_met_closely_and_never_broken(limit: int, start: int) -> None:
    files = Files(MaxSize(limit, "drop"), lambda p: p)
    answer = files.search(start)
    if limit < 500 + files.whole * (1000 - MAX_PRUNE) // 1000:
        assert not answer.holds and answer.choice.prune == MAX_PRUNE
        return
    assert answer.size <= limit
    assert answer.choice.prune == 0 or answer.size > 0.94 * limit, (answer, files.asked)


def test_what_cannot_be_met_ends_at_the_gentlest_point() -> None:
    for steps in LINE_STEPS.values():
        files = Files(MaxDrop(1.0), lambda p: 2.0 + p)
        answer = files.search(steps=steps)
        assert not answer.holds and answer.choice.prune == 0


def test_steps_end_early_close_below_the_target() -> None:
    files = Files(MaxDrop(1.0), lambda p: 0.98 if p == 0.3 else p)
    assert files.search().choice.prune == 300 and files.asked == [300]


def test_points_that_are_known_are_not_asked_again() -> None:
    files = Files(MaxDrop(1.0), lambda p: 0.1 * math.exp(5 * p))
    known = files.measure(0)
    points = search_line(files.measure, files.target, 300, 4, [known])
    assert points[0] is known and files.asked.count(0) == 1 and files.asked[1] > 0


def test_next_points() -> None:
    # One point: by the slope given, no farther than the stride.
    assert next_point([(0.0, -0.5)], 5.0, 10.0) == pytest.approx(0.098)
    assert next_point([(0.0, -50.0)], 5.0, 1.0) == 1.0
    assert next_point([(0.0, 0.5)], -1.0, 10.0) == pytest.approx(0.51)
    # Between a point that holds and one that misses: false position, away from both.
    assert next_point([(2.0, 3.0), (1.0, -1.0)], 1.0, 1.0) == pytest.approx(1 + 0.99 / 4)
    assert next_point([(1.0, -0.001), (2.0, 3.0)], 1.0, 1.0) == pytest.approx(1.1)
    # Two points on one side: by their own slope, but by no less than a share of the slope given.
    assert next_point([(0.0, -0.5), (1.0, -0.49)], 1.0, 10.0) == pytest.approx(1 + 0.48 / 0.2)
    assert next_point([(0.0, -0.5), (1.0, -0.6)], 1.0, 10.0, 0.5) == pytest.approx(1 + 0.59 / 0.5)
    assert CLOSE > 0
