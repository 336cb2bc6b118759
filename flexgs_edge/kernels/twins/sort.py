"""Twins of `cl_kernels/sort.cl`: a stable radix sort by blocks, pass by pass."""

import numpy as np

from flexgs_edge.constants import CULLED
from flexgs_edge.kernels.twins.arithmetic import Array, Size

DIGITS = 1 << 11


def block_of(count: int, blocks: int) -> Array:
    """[count], the block of each element: block b holds [count * b // blocks, count * (b + 1) // blocks)."""
    return ((np.arange(count, dtype=np.int64) + 1) * blocks - 1) // max(count, 1)


def _count(cells: Array, counts: Array, blocks: int) -> None:
    counts[: DIGITS * blocks] = np.bincount(cells, minlength=DIGITS * blocks)


def _scatter(cells: Array, offsets: Array, pairs: tuple[tuple[Array, Array], ...]) -> None:
    order = np.argsort(cells, kind="stable")
    ordered = cells[order]
    at = offsets[ordered] + (np.arange(len(cells)) - np.searchsorted(ordered, ordered, side="left"))
    for values, out in pairs:
        out[at] = values[order]
    np.add.at(offsets, cells, np.uint32(1))


def sort_count_first(size: Size, count: int, keys: Array, bounds: Array, counts: Array, pairs: Array) -> None:
    """Histogram of the first digit ([blocks, DIGITS]), and the bounds of each block's shown splats, summed."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    block = block_of(count, blocks)[shown]
    _count(block * DIGITS + keys[shown] % DIGITS, counts, blocks)
    pairs[:] = np.bincount(block, weights=bounds[shown], minlength=blocks).astype(np.uint64)


def sort_scatter_first(size: Size, count: int, keys: Array, offsets: Array, keys_out: Array, ids_out: Array) -> None:
    """The first pass: keys and rows of the shown splats, sorted by the lowest digit."""
    shown, blocks = np.flatnonzero(keys[:count] != CULLED), size[0]
    cells = block_of(count, blocks)[shown] * DIGITS + keys[shown] % DIGITS
    _scatter(cells, offsets, ((keys[shown], keys_out), (shown.astype(np.uint32), ids_out)))


def sort_count(size: Size, count: int, shift: int, keys: Array, counts: Array) -> None:
    """Histogram of the digit at `shift`."""
    digits = (keys[:count] >> np.uint32(shift)) % DIGITS
    _count(block_of(count, size[0]) * DIGITS + digits, counts, size[0])


def sort_scatter(
    size: Size, count: int, shift: int, keys: Array, ids: Array, offsets: Array, keys_out: Array, ids_out: Array
) -> None:
    """One pass by the digit at `shift`."""
    digits = (keys[:count] >> np.uint32(shift)) % DIGITS
    cells = block_of(count, size[0]) * DIGITS + digits
    _scatter(cells, offsets, ((keys[:count], keys_out), (ids[:count], ids_out)))


def exclusive_scan(size: Size, cells: int, blocks: int, values: Array) -> None:
    """Turn [blocks, cells] counts into offsets, cell by cell, in place; the total comes after them."""
    counts = values[: blocks * cells].reshape(blocks, cells)
    total = np.cumsum(counts.T.reshape(-1), dtype=np.uint32)
    values[blocks * cells] = total[-1]
    counts[:] = np.concatenate([np.zeros(1, np.uint32), total[:-1]]).reshape(cells, blocks).T
