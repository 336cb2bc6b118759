"""Twins of `cl_kernels/sort.cl`: a stable radix sort by blocks, pass by pass."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import CULLED

DIGITS = 1 << 11


def block_of(count: int, blocks: int) -> np.ndarray:
    """[count] block of each element: block b holds [count * b // blocks, count * (b + 1) // blocks)."""
    return ((np.arange(count, dtype=np.int64) + 1) * blocks - 1) // max(count, 1)


def _count(cells: np.ndarray, counts: np.ndarray, blocks: int) -> None:
    counts[: DIGITS * blocks] = np.bincount(cells, minlength=DIGITS * blocks)


def _scatter(cells: np.ndarray, offsets: np.ndarray, pairs: tuple[tuple[np.ndarray, np.ndarray], ...]) -> None:
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    first = np.searchsorted(ordered, ordered, side="left")
    at = offsets[ordered] + (np.arange(len(cells)) - first)
    for values, out in pairs:
        out[at] = values[order]
    np.add.at(offsets, cells, np.uint32(1))


def sort_count_first(
    size: tuple[int, ...], count: int, keys: np.ndarray, bounds: np.ndarray, counts: np.ndarray, pairs: np.ndarray
) -> None:
    """Histogram of the first digit ([DIGITS, blocks]) and tiles of each block's shown splats."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    block = block_of(count, blocks)[shown]
    _count((keys[shown] % DIGITS).astype(np.int64) * blocks + block, counts, blocks)
    pairs[:] = np.bincount(block, weights=bounds[shown], minlength=blocks).astype(np.uint64)


def sort_scatter_first(
    size: tuple[int, ...], count: int, keys: np.ndarray, offsets: np.ndarray, keys_out: np.ndarray, ids_out: np.ndarray
) -> None:
    """First pass: keys and rows of the shown splats, by the lowest digit."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    cells = (keys[shown] % DIGITS).astype(np.int64) * blocks + block_of(count, blocks)[shown]
    _scatter(cells, offsets, ((keys[shown], keys_out), (shown.astype(np.uint32), ids_out)))


def sort_count(size: tuple[int, ...], count: int, shift: int, keys: np.ndarray, counts: np.ndarray) -> None:
    """Histogram of the digit at `shift`."""
    digits = (keys[:count] >> np.uint32(shift)) % DIGITS
    _count(digits.astype(np.int64) * size[0] + block_of(count, size[0]), counts, size[0])


def sort_scatter(
    size: tuple[int, ...],
    count: int,
    shift: int,
    keys: np.ndarray,
    ids: np.ndarray,
    offsets: np.ndarray,
    keys_out: np.ndarray,
    ids_out: np.ndarray,
) -> None:
    """One pass by the digit at `shift`."""
    digits = (keys[:count] >> np.uint32(shift)) % DIGITS
    cells = digits.astype(np.int64) * size[0] + block_of(count, size[0])
    _scatter(cells, offsets, ((keys[:count], keys_out), (ids[:count], ids_out)))


def exclusive_scan(size: tuple[int, ...], count: int, values: np.ndarray) -> None:
    """Exclusive prefix sum in place; `values[count]` receives the total."""
    total = np.cumsum(values[:count], dtype=np.uint32)
    values[1 : count + 1] = total
    values[0] = 0
