"""The Morton curve, on which neighbours are near each other in space."""

import numpy as np

from flexgs_edge.memory.rows import blocks, put_rows, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage, stable_order


def morton(cells: np.ndarray) -> np.ndarray:
    """[n] u64, Morton indices of `cells` ([3, n], 0 to 2^21 - 1); of each three bits, x has the highest.

    >>> morton(np.array([[1, 0], [0, 0], [0, 3]])).tolist()
    [4, 9]
    """
    x, y, z = (_spread(axis.astype(np.uint64)) for axis in cells)
    return x << np.uint64(2) | y << np.uint64(1) | z


def near_rows(means: np.ndarray, storage: Storage = IN_MEMORY) -> np.ndarray:
    """[n] i64, the rows of `means` ([3, n]) in an order along a Morton curve, in which neighbours are near each other."""
    # Cells count ranks along each axis, so that a few far rows do not squeeze the rest into one cell.
    count = means.shape[1]
    cells, index = storage.empty(means.shape, np.int16), storage.empty((count,), np.uint64)
    for line, ranks in zip(means, cells, strict=True):
        order = stable_order(line, storage)
        for part in blocks(count):
            ranks[order[part]] = np.arange(part.start, part.stop) * 1024 // count
    for part in blocks(count):
        put_rows(index, part, morton(read_rows(cells, part)))
    return stable_order(index, storage)


def _spread(bits: np.ndarray) -> np.ndarray:
    """Spread the bits of 21-bit numbers: two zero bits before each."""
    for shift, mask in (
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    ):
        bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
    return bits
