"""Twins of `cl_kernels/sort.cl`: a stable radix sort by blocks, pass by pass."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import CULLED

DIGITS = 1 << 11


def block_of(count: int, blocks: int) -> np.ndarray:
    """[count], the block of each element: block b holds [count * b // blocks, count * (b + 1) // blocks)."""
    return ((np.arange(count, dtype=np.int64) + 1) * blocks - 1) // max(count, 1)


def _count(cells: np.ndarray, counts: np.ndarray, blocks: int) -> None:
    counts[: DIGITS * blocks] = np.bincount(cells, minlength=DIGITS * blocks)


def _scatter(cells: np.ndarray, offsets: np.ndarray, pairs: tuple[tuple[np.ndarray, np.ndarray], ...]) -> None:
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    at = offsets[ordered] + (np.arange(len(cells)) - np.searchsorted(ordered, ordered, side="left"))
    for values, out in pairs:
        out[at] = values[order]
    np.add.at(offsets, cells, np.uint32(1))


def sort_count_first(
    size: tuple[int, ...], count: int, keys: np.ndarray, bounds: np.ndarray, counts: np.ndarray, pairs: np.ndarray
) -> None:
    """Histogram of the first digit ([blocks, DIGITS]), and the bounds of each block's shown splats, summed."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    block = block_of(count, blocks)[shown]
    _count(block * DIGITS + keys[shown] % DIGITS, counts, blocks)
    pairs[:] = np.bincount(block, weights=bounds[shown], minlength=blocks).astype(np.uint64)


def sort_scatter_first(
    size: tuple[int, ...], count: int, keys: np.ndarray, offsets: np.ndarray, keys_out: np.ndarray, ids_out: np.ndarray
) -> None:
    """The first pass: keys and rows of the shown splats, sorted by the lowest digit."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    cells = block_of(count, blocks)[shown] * DIGITS + keys[shown] % DIGITS
    _scatter(cells, offsets, ((keys[shown], keys_out), (shown.astype(np.uint32), ids_out)))


def sort_count(size: tuple[int, ...], count: int, shift: int, keys: np.ndarray, counts: np.ndarray) -> None:
    """Histogram of the digit at `shift`."""
    digits = (keys[:count] >> np.uint32(shift)) % DIGITS
    _count(block_of(count, size[0]) * DIGITS + digits, counts, size[0])


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
    cells = block_of(count, size[0]) * DIGITS + digits
    _scatter(cells, offsets, ((keys[:count], keys_out), (ids[:count], ids_out)))


def exclusive_scan(size: tuple[int, ...], cells: int, blocks: int, values: np.ndarray) -> None:
    """Turn [blocks, cells] counts into offsets, cell by cell, in place; the total comes after them."""
    counts = values[: blocks * cells].reshape(blocks, cells)
    total = np.cumsum(counts.T.reshape(-1), dtype=np.uint32)
    values[blocks * cells] = total[-1]
    counts[:] = np.concatenate([np.zeros(1, np.uint32), total[:-1]]).reshape(cells, blocks).T
