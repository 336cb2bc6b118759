"""The choice by one multiplier on costs made by hand: every branch, and the colour that dropped bands leave behind."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexgs_edge.constants import SH_C0
from flexgs_edge.memory.rows import BLOCK_ROWS
from flexgs_edge.methods.best.allocation import (
    REMOVAL_FACTOR,
    SH_FACTOR,
    BitModel,
    OneDegree,
    choose,
    drop_bands,
    keep_most,
    keep_one,
)
from flexgs_edge.methods.best.costs import RemovalCosts

BITS = BitModel(50.0, (10.0, 20.0, 30.0))


def costs_of(removal: list[float], sh: list[list[float]], weight2: list[float] | None = None) -> RemovalCosts:
    """Costs of some Gaussians; `sh` has a list for each lower degree."""
    count = len(removal)
    return RemovalCosts(
        np.array(removal, np.float64),
        np.ones(count) if weight2 is None else np.array(weight2, np.float64),
        np.array(sh, np.float64).reshape(len(sh), count),
        np.zeros((len(sh), 3, count), np.float32),
    )


def chosen(costs: RemovalCosts, multiplier: float, **words: bool) -> list[int]:
    """The degree of every Gaussian, -1 for what goes."""
    keep, degrees = choose(costs, BITS, multiplier, **words)
    assert keep.dtype == bool and degrees.dtype == np.uint8
    return np.where(keep, degrees.astype(int), -1).tolist()


def test_bits_add_up_by_degree() -> None:
    assert [BITS.of_degree(degree) for degree in range(4)] == [50, 60, 80, 110]
    assert BitModel(40.0, ()).of_degree(0) == 40


@pytest.mark.parametrize(
    ("removal", "sh", "expected"),
    [
        (0.0, (0, 0, 0), -1),  # worth nothing at all
        (49.0 / REMOVAL_FACTOR, (0, 0, 0), -1),  # just cheaper than its bits without SH
        (51.0 / REMOVAL_FACTOR, (0, 0, 0), 0),
        (1e9, (0, 0, 0), 0),
        (1e9, (9 / SH_FACTOR, 0, 0), 0),  # the first band is dearer than what it mends
        (1e9, (11 / SH_FACTOR, 0, 0), 1),
        (1e9, (100, 19 / SH_FACTOR, 0), 1),
        (1e9, (100, 21 / SH_FACTOR, 0), 2),
        (1e9, (100, 100, 29 / SH_FACTOR), 2),
        (1e9, (100, 100, 31 / SH_FACTOR), 3),
        (1e9, (59 / SH_FACTOR, 59 / SH_FACTOR, 59 / SH_FACTOR), 0),  # all three bands are needed, and cost 60
        (1e9, (61 / SH_FACTOR, 61 / SH_FACTOR, 61 / SH_FACTOR), 3),
        (109.0 / REMOVAL_FACTOR, (1e3, 1e3, 1e3), -1),  # kept it would need all its SH, and that is too dear
        (111.0 / REMOVAL_FACTOR, (1e3, 1e3, 1e3), 3),
    ],
)
def test_each_branch(removal: float, sh: tuple[float, ...], expected: int) -> None:
    assert chosen(costs_of([removal], [[cost] for cost in sh]), 1.0) == [expected]
    # Costs and the multiplier in another unit: the same choice.
    assert chosen(costs_of([7e-6 * removal], [[7e-6 * cost] for cost in sh]), 7e-6) == [expected]


def test_each_gaussian_for_itself() -> None:
    costs = costs_of([0, 1e9, 1e9, 60], [[0, 0, 50, 50], [0, 0, 50, 0], [0, 0, 50, 0]])
    assert chosen(costs, 1.0) == [-1, 0, 3, 1]
    assert chosen(costs, 1e-6) == [-1, 0, 3, 1]
    assert chosen(costs, 1e12) == [-1, -1, -1, -1]


def test_unseen_gaussians_are_kept_without_sh() -> None:
    costs = costs_of([0, 1e9, 0], [[0, 1e9, 1e9]], [0.0, 1.0, 0.0])
    assert chosen(costs, 1.0) == [0, 1, 0]
    assert chosen(costs, 1e30) == [0, -1, 0]


def test_scenes_without_sh_and_without_gaussians() -> None:
    assert chosen(costs_of([0, 100], []), 1.0) == [-1, 0]
    assert chosen(costs_of([], []), 1.0) == [] and chosen(costs_of([], [[], []]), 1.0) == []


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-6, 6), st.floats(0.1, 4))
def test_the_choice_is_the_cheapest_and_shrinks_with_the_multiplier(seed: int, exponent: float, factor: float) -> None:
    rng = np.random.default_rng(seed)
    costs = costs_of(rng.lognormal(3, 3, 20).tolist(), np.sort(rng.lognormal(1, 3, (3, 20)), axis=0)[::-1].tolist())
    multiplier = 10.0**exponent
    found = np.array(chosen(costs, multiplier))
    table = [REMOVAL_FACTOR * costs.removal]
    table += [SH_FACTOR * costs.sh[degree] + multiplier * BITS.of_degree(degree) for degree in range(3)]
    table.append(np.full(20, multiplier * BITS.of_degree(3)))
    every = np.array(table)
    np.testing.assert_allclose(every[found + 1, np.arange(20)], every.min(axis=0), rtol=1e-12)
    dearer = np.array(chosen(costs, multiplier * (1 + factor)))
    assert (dearer <= found).all()


def planes_of(count: int, degree: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(61)
    return {
        "sh_dc": rng.normal(size=(3, count)).astype(np.float32),
        "sh_rest": rng.normal(size=(3 * ((degree + 1) ** 2 - 1), count)).astype(np.float32),
        "means": rng.normal(size=(3, count)).astype(np.float32),
    }


def test_dropped_bands_leave_their_mean() -> None:
    planes = planes_of(4, 3)
    mean = np.random.default_rng(62).normal(size=(3, 3, 4)).astype(np.float32)
    degrees = np.array([0, 1, 2, 3], np.uint8)
    found = drop_bands(planes, np.arange(4), degrees, mean, SH_C0)
    np.testing.assert_array_equal(found["means"], planes["means"])
    for row, degree in enumerate(degrees.tolist()):
        kept = (degree + 1) ** 2 - 1
        rest, before = (p["sh_rest"].reshape(3, 15, 4)[:, :, row] for p in (found, planes))
        np.testing.assert_array_equal(rest[:, :kept], before[:, :kept])
        assert (rest[:, kept:] == 0).all()
        added = found["sh_dc"][:, row] - planes["sh_dc"][:, row]
        wanted = mean[degree, :, row] / SH_C0 if degree < 3 else np.zeros(3)
        np.testing.assert_allclose(added, wanted, atol=1e-5)
    assert found["sh_dc"].dtype == found["sh_rest"].dtype == np.float32
    assert planes["sh_rest"].all()  # what was given is as it was


def test_nothing_to_drop() -> None:
    planes = planes_of(3, 0)
    rows = np.array([0, 2])
    for degree in (0, 2):
        planes, means = planes_of(3, degree), np.ones((degree, 3, 3), np.float32)
        found = drop_bands(planes, rows, np.full(2, degree, np.uint8), means, SH_C0)
        assert set(found) == set(planes)
        for name, values in planes.items():
            np.testing.assert_array_equal(found[name], values[:, rows])
    none = drop_bands(planes_of(0, 2), rows[:0], np.zeros(0, np.uint8), np.zeros((2, 3, 0), np.float32), SH_C0)
    assert none["sh_dc"].shape == (3, 0)


def test_bands_of_some_rows_in_any_blocks() -> None:
    """The rows that stay give what they would give alone, wherever the blocks of a pass end."""
    rng, count = np.random.default_rng(63), 2 * BLOCK_ROWS + BLOCK_ROWS // 2
    planes, mean = planes_of(count, 3), rng.normal(size=(3, 3, count)).astype(np.float32)
    rows = np.sort(rng.permutation(count)[: count - 99])
    degrees = rng.integers(0, 4, len(rows)).astype(np.uint8)
    found = drop_bands(planes, rows, degrees, mean, SH_C0)
    for size in (7, 999, BLOCK_ROWS - 1):
        for start in range(0, len(rows), size if size > 7 else BLOCK_ROWS - 3):
            part = slice(start, start + size)
            some = rows[part]
            alone = {name: values[:, some] for name, values in planes.items()}
            expected = drop_bands(alone, np.arange(len(some)), degrees[part], mean[..., some], SH_C0)
            for name, values in found.items():
                np.testing.assert_array_equal(values[:, part], expected[name])


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_one_degree_for_all_is_the_cheapest_of_its_kind(seed: int, multiplier: float) -> None:
    rng = np.random.default_rng(seed)
    sh = np.sort(rng.uniform(0, 100, (3, 12)), axis=0)[::-1]
    costs = costs_of(rng.uniform(0, 200, 12).tolist(), sh.tolist())
    keep, degrees = OneDegree()(costs, BITS, multiplier)
    assert len(set(degrees.tolist())) == 1

    def total(kept: np.ndarray, degree: int) -> float:
        lost = SH_FACTOR * costs.sh[degree][kept].sum() if degree < 3 else 0.0
        bits = multiplier * BITS.of_degree(degree) * kept.sum()
        return float(REMOVAL_FACTOR * costs.removal[~kept].sum() + lost + bits)

    found = total(keep, int(degrees[0]))
    for degree in range(4):
        alone = np.array([total(np.arange(12) != row, degree) for row in range(12)])
        assert found <= min(total(np.ones(12, bool), degree), alone.min()) * (1 + 1e-9)


def test_one_degree_never_rises() -> None:
    costs = costs_of([50.0] * 3, [[9.0] * 3, [4.0] * 3, [1.0] * 3])
    chosen = OneDegree()
    fine, coarse = 1e-3, 3.0
    assert chosen(costs, BITS, fine)[1].tolist() == [3, 3, 3] and chosen(costs, BITS, coarse)[1].tolist() == [0, 0, 0]
    assert chosen(costs, BITS, fine)[1].tolist() == [0, 0, 0] and OneDegree()(costs, BITS, fine)[1].tolist() == [
        3,
        3,
        3,
    ]


def test_one_degree_keeps_what_nobody_sees() -> None:
    costs = costs_of([0.0, 1e9, 0.0], [[0, 1e6, 0]] * 3, weight2=[0.0, 1.0, 1.0])
    keep, degrees = OneDegree()(costs, BITS, 1.0)
    assert keep.tolist() == [True, True, False] and degrees.tolist() == [3, 3, 3]


def test_one_that_a_pose_sees_is_always_kept() -> None:
    """The one whose removal costs most; rows that no pose sees do not count."""
    costs = costs_of([3, 9, 9, 1e9], [], [1.0, 1.0, 1.0, 0.0])
    keep = np.array([False, False, False, True])
    keep_one(keep, costs)
    assert keep.tolist() == [False, True, False, True]
    keep_one(keep, costs)
    assert keep.tolist() == [False, True, False, True]
    unseen = costs_of([3, 9], [], [0.0, 0.0])
    none = np.zeros(2, bool)
    keep_one(none, unseen)
    assert not none.any()
    worthless = np.zeros(2, bool)
    keep_one(worthless, costs_of([0, 0], [], [1.0, 1.0]))
    assert worthless.tolist() == [True, False]


def test_no_more_than_the_most_stay() -> None:
    """Rows that no pose sees go first, then the cheapest of those that stay; of equal ones the first."""
    removal, weight2 = np.array([5.0, 1, 3, 3, 9, 0, 2]), np.array([1.0, 1, 1, 1, 1, 0, 1])
    costs = RemovalCosts(removal, weight2, np.zeros((0, 7)), np.zeros((0, 3, 7), np.float32))
    for most, left in (
        (7, [0, 2, 3, 4, 5, 6]),
        (6, [0, 2, 3, 4, 5, 6]),
        (5, [0, 2, 3, 4, 6]),
        (3, [0, 3, 4]),
        (1, [4]),
    ):
        keep = np.array([1, 0, 1, 1, 1, 1, 1], bool)
        keep_most(keep, costs, most)
        assert np.flatnonzero(keep).tolist() == left
