"""ADP: orders, rates and blocks."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexgs_edge.errors import InputError
from flexgs_edge.goals.steps import Choice
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores, ranks_from_order, select_rows
from quantized_scenes import make_scene


def test_order_is_ascending_and_ties_keep_their_index() -> None:
    scores = np.array([2.0, -np.inf, 2.0, 0.0, -0.0, np.inf])
    order = order_from_scores(scores)
    assert order.dtype == np.int64
    assert order.tolist() == [1, 3, 4, 0, 2, 5]
    assert ranks_from_order(order).tolist() == [3, 0, 4, 1, 2, 5]


def test_ties_of_many_rows_keep_their_index() -> None:
    # Sorts that are not stable still are on a handful of rows.
    scores = np.arange(5000) % 3 == 0
    order = order_from_scores(scores.astype(np.float64))
    np.testing.assert_array_equal(order, np.concatenate([np.flatnonzero(~scores), np.flatnonzero(scores)]))


def test_nan_score_is_named() -> None:
    with pytest.raises(InputError, match="2 of 4 are NaN, the first at row 1"):
        order_from_scores(np.array([0.0, np.nan, 1.0, np.nan]))


def test_scores_of_two_dimensions_are_refused() -> None:
    with pytest.raises(InputError, match="shape"):
        order_from_scores(np.zeros((2, 2)))


@pytest.mark.parametrize(("prune", "sh"), [(-1, 0), (0, -1), (1001, 0), (0, 1001), (500, 501)])
def test_bad_rates(prune: int, sh: int) -> None:
    with pytest.raises(InputError, match="add up to at most 1"):
        Choice(prune, sh)


def test_rates_from_shares() -> None:
    assert Choice.from_rates(0.29, 0.71) == Choice(290, 710)
    with pytest.raises(InputError):
        Choice.from_rates(float("nan"), 0.0)


@pytest.mark.parametrize("count", [0, 1, 2, 7, 999, 1000, 1001])
@pytest.mark.parametrize("choice", [Choice(0, 0), Choice(400, 400), Choice(1000, 0), Choice(0, 1000), Choice(333, 334)])
def test_counts_follow_the_floor_formula(count: int, choice: Choice) -> None:
    ranks = np.random.default_rng(count).permutation(count)
    with_sh, without = select_rows(ranks, choice)
    n_prune = count * choice.prune // 1000
    n_sh = count * (choice.prune + choice.sh) // 1000 - n_prune
    assert len(without) == n_sh
    assert len(with_sh) == count - n_prune - n_sh
    assert with_sh.dtype == without.dtype == np.int64


@given(st.integers(0, 60), st.integers(0, 1000), st.integers(0, 1000), st.randoms(use_true_random=False))
def test_blocks_partition_the_kept_rows(count: int, prune: int, sh: int, random) -> None:  # type: ignore[no-untyped-def]
    choice = Choice(prune, min(sh, 1000 - prune))
    scores = np.array([random.choice([0.0, 1.0, 2.0]) for _ in range(count)])
    has_sh = np.array([random.random() < 0.5 for _ in range(count)], bool)
    ranks = ranks_from_order(order_from_scores(scores))
    with_sh, without = select_rows(ranks, choice, has_sh)
    for block in (with_sh, without):
        assert (np.diff(block) > 0).all()
    kept = np.sort(np.concatenate([with_sh, without]))
    np.testing.assert_array_equal(kept, np.flatnonzero(ranks >= choice.pruned(count)))
    assert has_sh[with_sh].all()
    assert (ranks[with_sh] >= choice.boundary(count)).all()
    # Rows that lost their SH by rank, and not for having none, are inside the band.
    assert (ranks[without[has_sh[without]]] < choice.boundary(count)).all()


def test_rows_without_sh_take_no_place_of_others() -> None:
    ranks = np.arange(10)
    has_sh = np.ones(10, bool)
    has_sh[[2, 9]] = False
    with_sh, without = select_rows(ranks, Choice(200, 300), has_sh)
    assert without.tolist() == [2, 3, 4, 9]
    assert with_sh.tolist() == [5, 6, 7, 8]


def test_has_sh_of_another_length() -> None:
    with pytest.raises(InputError, match="expected 3 rows, got 2"):
        select_rows(np.arange(3), Choice(0, 0), np.ones(2, bool))


@pytest.mark.parametrize("chunk_rows", [1, 7, 65536])
def test_nonzero_sh_reads_by_chunks(chunk_rows: int) -> None:
    scene = make_scene(40, sh_degree=2)
    found = nonzero_sh(scene, chunk_rows)
    np.testing.assert_array_equal(found, scene.read(slice(0, 40), ["sh_rest"])["sh_rest"].any(axis=0))
    assert 0 < found.sum() < 40


def test_nonzero_sh_at_degree_zero_and_of_nothing() -> None:
    assert not nonzero_sh(make_scene(5, sh_degree=0)).any()
    assert nonzero_sh(make_scene(0)).shape == (0,)
