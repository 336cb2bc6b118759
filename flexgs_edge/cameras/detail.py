"""How fine each Gaussian is among those around it, and which of them to draw where a part is enough.

Where cameras stood, a trained scene shows fine Gaussians, as fine as the pictures were. Behind and below what they saw lie wide
ones that no picture corrected. So whoever sees many that are wider than those around them stands where no camera stood.
"""

from typing import Any

import numpy as np

AROUND = 4.0
"""Side of the box around a Gaussian, in its own deviations, within which others tell how wide is usual there."""
WIDEST = 1.5  # Logs above this count as this: how much wider a sky is than what stands before it tells nothing
BITS = 21  # Bits of a position along each axis of the curve
TOUCH = 4.0
"""Gaussians touch if they lie nearer to each other than so many of their deviations, or up to a few times that far."""
ALIKE_CELLS = 21  # Bits of the number of a cell along each axis; farther out the numbers begin anew
CRUMB_ROWS, CRUMB_SHARE = 32, 0.001  # What holds fewer Gaussians, or less of all, is no thing to look at
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


def things(means: np.ndarray, sizes: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Tell things apart: Gaussians that are joined by touching others of about their size.

    Gaussians lie in the cells of an octree, at a level by their own size. Those in one cell touch, and those in cells side by
    side, of one level or of two levels that follow each other.

    `means`: [3, n]. `sizes`: [n], deviations. `middle`: [3]. Returns the number of the thing of each ([n] int64): 0 for what
    holds most, -1 for crumbs.
    """
    logs = np.rint(np.log2(np.maximum(TOUCH * sizes, 1e-300)) * UNITS)
    levels = np.ceil(logs / UNITS).astype(np.int64)
    order = np.argsort(levels, kind="stable")
    node, count = np.empty(levels.size, np.int64), 0
    roots, pairs = [], [np.zeros(0, np.int64)]
    finer = None
    for rows in np.split(order, np.flatnonzero(np.diff(levels[order])) + 1):
        level = int(levels[rows[0]])
        places = np.floor((means[:, rows] - middle[:, None]) / 2.0**level) + 2 ** (ALIKE_CELLS - 1)
        x, y, z = np.mod(places, 2**ALIKE_CELLS).astype(np.int64)
        cells, own = np.unique(_cell(x, y, z), return_inverse=True)
        node[rows] = count + own
        root = np.arange(cells.size)
        for away in np.ndindex(3, 3, 3):
            if away > (1, 1, 1):
                root = _united(root, *_met(cells, cells + _cell(*(step - 1 for step in away))))
        if finer is not None and finer[0] == level - 1:
            x, y, z = (finer[1] >> ALIKE_CELLS * axis & 2**ALIKE_CELLS - 1 for axis in range(3))
            for corner in np.ndindex(2, 2, 2):
                # The eight cells that a finer one lies in and nearest to.
                near = (
                    (part >> 1) + 2 ** (ALIKE_CELLS - 2) + step * (2 * (part & 1) - 1)
                    for part, step in zip((x, y, z), corner)
                )
                one, other = _met(cells, _cell(*near))
                pairs.append(np.unique(finer[2][one] << 32 | count + root[other]))
        finer = level, cells, count + root
        roots.append(count + root)
        count += cells.size
    joined = np.concatenate(pairs)
    found = _united(np.concatenate(roots), joined >> 32, joined & 2**32 - 1)[node]
    held = np.bincount(found, minlength=count)
    large = np.flatnonzero(held >= max(CRUMB_ROWS, CRUMB_SHARE * levels.size))
    numbers = np.full(count, -1)
    numbers[large[np.argsort(-held[large], kind="stable")]] = np.arange(large.size)
    return numbers[found]


def _cell(x: Any, y: Any, z: Any) -> Any:
    return x + (y << ALIKE_CELLS) + (z << 2 * ALIKE_CELLS)


def _met(cells: np.ndarray, wanted: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places of those of `wanted` that are among `cells`, ascending, and their places there."""
    at = np.minimum(np.searchsorted(cells, wanted), cells.size - 1)
    met = np.flatnonzero(cells[at] == wanted)
    return met, at[met]


def _united(root: np.ndarray, one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The least of each tree as the root of all its nodes, once each of `one` is joined to that of `other`."""
    while True:
        one, other = root[one], root[other]
        apart = one != other
        if not apart.any():
            return root
        one, other = one[apart], other[apart]
        np.minimum.at(root, np.maximum(one, other), np.minimum(one, other))
        while not np.array_equal(root, up := root[root]):
            root = up


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
