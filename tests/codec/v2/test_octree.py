"""Octrees: round trips, Morton indices, limits."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.codec.v2.walk import OCTREE_CONTEXTS, TooManyNodes, unmorton, walk_octree
from flexgs_edge.scene.curve import morton


def some_cells(count: int, depth: int, seed: int = 0) -> np.ndarray:
    cells = np.random.default_rng(seed).integers(0, 1 << depth, (3, count))
    return np.unique(morton(cells))


@pytest.mark.parametrize(("count", "depth"), [(1, 0), (1, 1), (1, 21), (8, 1), (500, 3), (500, 9), (65, 21)])
def test_round_trip(count: int, depth: int) -> None:
    cells = some_cells(count, depth)
    batches: list[np.ndarray] = []

    def write(contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        assert symbols is not None and symbols.all() and len(contexts) == len(symbols)
        assert contexts.max() < OCTREE_CONTEXTS
        batches.append(symbols)
        return symbols

    walk_octree(depth, len(cells), write, cells)
    assert len(batches) == depth
    left = iter(batches)
    np.testing.assert_array_equal(walk_octree(depth, len(cells), lambda contexts, _: next(left)), cells)


def test_morton_indices() -> None:
    cells = np.random.default_rng(0).integers(0, 1 << 21, (3, 100))
    cells[:, :2] = [[0, 2**21 - 1]] * 3
    index = morton(cells)
    slow = [
        sum((int(cell[axis]) >> bit & 1) << 3 * bit + 2 - axis for bit in range(21) for axis in range(3))
        for cell in cells.T
    ]
    assert index.tolist() == slow
    np.testing.assert_array_equal(unmorton(index), cells)


def test_nodes_are_bounded_by_rows() -> None:
    calls = []

    def all_children(contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        calls.append(len(contexts))
        return np.full(len(contexts), 255, np.uint8)

    with pytest.raises(TooManyNodes, match="at most 100 nodes at level 18, got 512"):
        walk_octree(21, 100, all_children)
    assert calls == [1, 8, 64]
