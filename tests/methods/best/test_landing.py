"""Results that are a little too large, or better than asked, lose their cheapest Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.methods.best.landing import DESCENDED, NEAR_QUALITY, REACH, REFITTED, land, land_on_quality
from flexgs_edge.scene.fields import FIELD
from synthetic import random_scene

COUNT = 2000
JUMPS = 0.01
"""With so few rows, a few more or less change the fit of the coder, and the size jumps by this share."""


@pytest.fixture(scope="module")
def grid() -> GridScene:
    planes = random_scene(COUNT, 5, 1).read(slice(0, COUNT), list(FIELD))
    return to_grid(planes, np.arange(COUNT) % 2, StepSizes(0.01, 0.1, 0.03, 0.2, 0.05, (0.04,)), np.zeros(3))[0]


def size_of(grid: GridScene) -> int:
    return coded_size(grid, {})


def landed(grid: GridScene, share: float, removal: np.ndarray) -> tuple[GridScene, int, int]:
    size = size_of(grid)
    return (*land(grid, removal, size, round(share * size), size_of, IN_MEMORY), round(share * size))


@pytest.mark.parametrize("share", [0.999, 0.98, 0.97])
def test_lands_just_below_the_limit(grid: GridScene, share: float) -> None:
    removal = np.random.default_rng(1).random(COUNT)
    found, size, limit = landed(grid, share, removal)
    assert size == size_of(found) and (1 - JUMPS) * limit <= size <= limit
    # The cheapest have gone, and no others: what is left is the same rows, in the order of a grid of their own.
    assert found.count < COUNT
    left = np.sort(removal)[COUNT - found.count :]
    kept = np.flatnonzero(removal >= left[0])
    for name in ("position", "scale", "dc"):
        ours, theirs = (np.sort(values, axis=1) for values in (getattr(found, name), getattr(grid, name)[:, kept]))
        np.testing.assert_array_equal(ours, theirs)


def test_outer_rows_may_go(grid: GridScene) -> None:
    """The box around the rows shrinks, so that the order along the curve changes."""
    removal = np.ones(COUNT)
    removal[np.abs(grid.position - grid.position.mean(axis=1, keepdims=True)).max(axis=0).argsort()[-100:]] = 0
    found, size, limit = landed(grid, 0.97, removal)
    assert size <= limit and (found.position.min(axis=1) > grid.position.min(axis=1)).any()


@pytest.mark.parametrize("share", [1.0, 1.02, np.exp(-REACH) - 0.01, 0.3])
def test_others_stay_as_they_are(grid: GridScene, share: float) -> None:
    found, size, _ = landed(grid, share, np.zeros(COUNT))
    assert found is grid and size == size_of(grid)


def test_sizes_that_do_not_fall_end_it(grid: GridScene) -> None:
    asked: list[int] = []

    def stubborn(smaller: GridScene) -> int:
        asked.append(smaller.count)
        return 1010

    found, size = land(grid, np.zeros(COUNT), 1010, 1000, stubborn, IN_MEMORY)
    assert found is grid and size == 1010 and len(asked) == 4 and asked == sorted(set(asked), reverse=True)


def test_one_gaussian_stays(grid: GridScene) -> None:
    one = grid.take(np.arange(1))
    assert land(one, np.zeros(1), 101, 100, size_of, IN_MEMORY) == (one, 101)


@pytest.mark.parametrize("power", [1.0, 1.3, 1.6])
@pytest.mark.parametrize("excess", [-0.02, -0.06, -0.15])
def test_lands_just_below_a_quality(grid: GridScene, excess: float, power: float) -> None:
    """Where the loss grows with some power of what is gone: the cheapest go first."""
    removal = np.random.default_rng(1).random(COUNT)
    seen: list[tuple[int, float]] = []

    def attempt(smaller: GridScene) -> list[float]:
        gone = COUNT - smaller.count
        seen.append((gone, excess + 3 * (gone / COUNT) ** power))
        return [seen[-1][1]]

    land_on_quality(grid, removal, [excess], attempt, IN_MEMORY, 9)
    best = max((found for _, found in seen if found <= 0.0), default=excess)
    missed = all(found > 0.0 for _, found in seen[: REFITTED[1]])
    assert len(seen) <= REFITTED[1] + missed and len({gone for gone, _ in seen}) == len(seen)
    assert best >= min(0.9 * excess, -NEAR_QUALITY) and (power != 1.0 or best >= -NEAR_QUALITY)


def test_each_bound_rises_at_its_own_pace(grid: GridScene) -> None:
    """The first bound binds at the beginning and falls by chance; the second one decides in the end."""
    seen: list[tuple[float, float]] = []

    def attempt(smaller: GridScene) -> list[float]:
        gone = (COUNT - smaller.count) / COUNT
        seen.append((-0.1 - gone, -0.2 + 3 * gone))
        return [*seen[-1]]

    land_on_quality(grid, np.random.default_rng(1).random(COUNT), [-0.1, -0.2], attempt, IN_MEMORY, 9, descended=True)
    assert 2 <= len(seen) <= DESCENDED[1] and -NEAR_QUALITY <= seen[-1][1] <= 0.0


@pytest.mark.parametrize("needless", [0.1, 0.2, 0.3])
def test_ever_more_go_while_nothing_is_lost(grid: GridScene, needless: float) -> None:
    """A large part of the scene that no view needs goes in a few strides. One of them may go too far, and is made good."""
    holds: list[float] = []
    misses: list[float] = []

    def attempt(smaller: GridScene) -> list[float]:
        gone = (COUNT - smaller.count) / COUNT
        excess = -0.06 - 0.01 * gone + 3 * max(gone - needless, 0.0)
        (holds if excess <= 0.0 else misses).append(gone)
        return [excess]

    land_on_quality(grid, np.random.default_rng(1).random(COUNT), [-0.06], attempt, IN_MEMORY, 9, descended=True)
    assert len(holds) + len(misses) <= DESCENDED[1] and max(holds) > 0.9 * needless


def test_fewer_go_behind_a_descent(grid: GridScene) -> None:
    asked: list[int] = []

    def attempt(smaller: GridScene) -> list[float]:
        asked.append(COUNT - smaller.count)
        return [-0.001]

    for descended in (False, True):
        land_on_quality(grid, np.zeros(COUNT), [-0.11], attempt, IN_MEMORY, 9, descended)
    assert asked == [round(0.1 * share * COUNT) for share, _ in (REFITTED, DESCENDED)]


def test_a_quality_that_is_met_is_left_alone(grid: GridScene) -> None:
    land_on_quality(grid, np.zeros(COUNT), [-0.5 * NEAR_QUALITY], lambda _: pytest.fail("no need"), IN_MEMORY, 9)


def test_removals_that_gain_quality(grid: GridScene) -> None:
    asked: list[int] = []

    def attempt(smaller: GridScene) -> list[float]:
        asked.append(smaller.count)
        return [-0.2]

    land_on_quality(grid, np.zeros(COUNT), [-0.1], attempt, IN_MEMORY, 9)
    assert len(asked) == REFITTED[1]
    land_on_quality(grid.take(np.arange(1)), np.zeros(1), [-0.1], attempt, IN_MEMORY, 9)
    assert len(asked) == REFITTED[1]


def test_rows_that_must_stay(grid: GridScene) -> None:
    """However much is wanted, only the others go, and at least one row stays."""
    removal = np.where(np.arange(COUNT) < 30, np.random.default_rng(1).random(COUNT), np.inf)
    counts: list[int] = []

    def attempt(smaller: GridScene) -> list[float]:
        counts.append(smaller.count)
        return [-0.15 + 1e-6 * (COUNT - smaller.count)]

    land_on_quality(grid, removal, [-0.2], attempt, IN_MEMORY, 9)
    assert counts and min(counts) == COUNT - 30
    found, size, _ = landed(grid, 0.97, removal)
    assert found is grid and size == size_of(grid)
