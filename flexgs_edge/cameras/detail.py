"""How fine each Gaussian is among those around it, and which of them to draw where a part is enough.

Where cameras stood, a trained scene shows fine Gaussians, as fine as the pictures were. Behind and below what they saw lie wide
ones that no picture corrected. So whoever sees many that are wider than those around them stands where no camera stood.
"""

import numpy as np

AROUND = 4.0
"""Side of the box around a Gaussian, in its own deviations, within which others tell how wide is usual there."""
WIDEST = 1.5  # Logs above this count as this: how much wider a sky is than what stands before it tells nothing
BITS = 21  # Bits of a position along each axis of the curve
UNITS = 2.0**16  # Logarithms are whole numbers of 1 / UNITS, so that their sums do not depend on the order


def smears(means: np.ndarray, sizes: np.ndarray, low: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Log of each size over the usual one in a box around it.

    `means`: [3, n]. `sizes`: [n], deviations. `low`, `side`: first corner and side of a cube. What lies outside is
    moved to its faces. Returns the logs ([n] f64, whole numbers of 1 / `UNITS`), and the place of each
    one ([n] int64) along a curve on which neighbours in space are near each other.
    """
    codes = _curve(means, low, side)
    order = np.argsort(codes, kind="stable")
    codes, logs = codes[order], np.rint(np.log(np.maximum(sizes[order], 1e-300)) * UNITS)
    total = np.concatenate([[0.0], np.cumsum(logs)])
    # Boxes are the cells of an octree, of the level that is nearest to the wanted side.
    level = np.clip(np.rint(np.log2(np.maximum(sizes[order] * (AROUND * 2**BITS / side), 1.0))), 0, BITS).astype(
        np.uint64
    )
    found = np.empty(logs.size)
    for each in np.unique(level):
        own, shift = level == each, np.uint64(3) * each
        cells = codes[own] >> shift
        first, end = (np.searchsorted(codes, (cells + np.uint64(step)) << shift) for step in (0, 1))
        found[own] = logs[own] - np.rint((total[end] - total[first]) / (end - first))
    found = np.minimum(found, WIDEST * UNITS)
    result, place = np.empty(logs.size), np.empty(logs.size, np.int64)
    result[order], place[order] = found, np.arange(logs.size)
    return result, place


def few_rows(areas: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows that stand for all: about `most` of them, and the factor by which each grows so that all cover as much.

    Large ones stand for themselves. Of small ones some stay, the fewer the smaller they are, and all of these are alike large.

    Returns the rows ([m] int64, ascending) and their growth ([m] f64, factors of the deviations, 1 or more).
    """
    if areas.size <= most:
        return np.arange(areas.size), np.ones(areas.size)
    ordered = np.sort(areas)
    expected = np.cumsum(ordered) / np.maximum(ordered, 1e-300) + (areas.size - 1 - np.arange(areas.size))
    fits = np.flatnonzero(expected <= most)
    least = max(float(ordered[fits[0]] if fits.size else ordered.sum() / most), 1e-300)
    chances = np.cumsum(np.rint(np.minimum(areas / least, 1.0) * UNITS)) // UNITS
    rows = np.flatnonzero(np.diff(chances, prepend=0.0) > 0)
    return rows, np.sqrt(np.maximum(least / np.maximum(areas[rows], 1e-300), 1.0))


def _curve(means: np.ndarray, low: np.ndarray, side: float) -> np.ndarray:
    """[n] u64, places along a Morton curve through a cube."""
    codes = np.zeros(means.shape[1], np.uint64)
    for axis in range(3):
        spread = np.clip((means[axis] - low[axis]) * (2**BITS / side), 0, 2**BITS - 1).astype(np.uint64)
        for shift, mask in (
            (32, 0x1F00000000FFFF),
            (16, 0x1F0000FF0000FF),
            (8, 0x100F00F00F00F00F),
            (4, 0x10C30C30C30C30C3),
            (2, 0x1249249249249249),
        ):
            spread = (spread | spread << np.uint64(shift)) & np.uint64(mask)
        codes |= spread << np.uint64(axis)
    return codes
