"""Brings a result to what was asked for, without making it anew: one that is a little too large, or better than need be."""

import math
from collections.abc import Callable, Sequence

import numpy as np

from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.storage import Storage
from flexgs_edge.scene.curve import morton

REACH = 0.04  # Largest log of size over limit that is landed. Beyond it, a new result at another multiplier is better.
NEAR_QUALITY = 0.02  # How far below what it allows, as a share of it, we are content
REFITTED, DESCENDED = (0.5, 1), (0.33, 6)
"""Share of the Gaussians to remove at first, for each unit of the log of what a quality allows, and most results that are made
and measured on the way; one more if none of them holds. Behind a descent each Gaussian matters more:
docs/results/tuning.md#landing"""


def land(
    grid: GridScene,  # the result
    removal: np.ndarray,  # [n] f64, cost of the removal of each of its rows, infinite for those that must stay
    size: int,  # its bytes
    limit: int,  # most bytes
    size_of: Callable[[GridScene], int],  # bytes of a grid's file
    storage: Storage,  # holds the new grid
    tries: int = 4,  # most times that the file is coded on the way
    near: float = 0.002,  # how far below the limit, as a share of it, we are content
) -> tuple[GridScene, int]:
    """Remove the Gaussians whose removal costs least, until the file just fits.

    Returns the grid and its bytes; those that were given if it fits already, is too large for this, or cannot be made to fit.
    """
    if not 0.0 < math.log(size / limit) <= REACH:
        return grid, size
    cheapest = np.argsort(removal, kind="stable")
    landed, fits, out = None, _beyond(removal), 0
    # Bytes of a row: at first the mean, then what the rows removed so far have taken.
    each = size / grid.count
    wanted = limit * (1 - near / 2)
    count, last = 0, size
    for _ in range(tries):
        count = min(max(count + math.ceil((last - wanted) / each), out + 1), fits - 1)
        if count <= out:
            break
        smaller = grid.take(_along_curve(grid.position, np.sort(cheapest[count:])), storage)
        last = size_of(smaller)
        if last <= limit:
            landed, fits = (smaller, last), count
            if last >= (1 - near) * limit:
                break
        else:
            out = count
        each = max((size - last) / count, each / 4)
    return landed or (grid, size)


def land_on_quality(
    grid: GridScene,  # the result, which holds
    removal: np.ndarray,  # [n] f64, cost of the removal of each of its rows, infinite for those that must stay
    excesses: Sequence[float],  # log of its loss over what is allowed, for each bound of the promise; all below 0
    attempt: Callable[[GridScene], Sequence[float]],
    storage: Storage,  # holds the grids
    most: int,  # most results, whatever is usual
    descended: bool = False,  # the result comes from a descent
) -> None:
    """Remove the Gaussians whose removal costs least, until a quality hardly holds.

    `attempt`: makes and measures the result of a grid, and returns its excesses.
    """
    cheapest = np.argsort(removal, kind="stable")
    least, beyond, aim = 0, _beyond(removal), -NEAR_QUALITY / 2
    known, missed = np.asarray(excesses), None
    share, tries = DESCENDED if descended else REFITTED
    usual = share * grid.count
    stride, slowest = (aim - known.max()) * usual, 1.0 / usual
    for number in range(min(tries + 1, most) if known.max() < -NEAR_QUALITY else 0):
        if number == tries and least:
            return
        count = min(least + round(stride), beyond - 1)
        if count <= least:
            return
        found = np.asarray(attempt(grid.take(_along_curve(grid.position, np.sort(cheapest[count:])), storage)))
        paces = (found - known) / (count - least)
        if found.max() > 0.0:
            beyond, missed = count, found
        elif found.max() >= -NEAR_QUALITY:
            return
        else:
            least, known = count, found
            if missed is None:
                slowest /= 2
            else:
                # A miss that stays one counts half as much each time: the loss rises late (Illinois rule of false position).
                missed = missed / 2
                paces = (missed - known) / (beyond - least)
        # Bounds rise at paces of their own, and one may fall by chance. None is taken to rise by less than half of what is usual
        # behind one result that holds, a quarter behind two, and so on.
        stride = float(((aim - known) / np.maximum(paces, slowest)).min())


def _beyond(removal: np.ndarray) -> int:
    """The least number of rows that cannot be removed. One row always stays."""
    return min(int(np.isfinite(removal).sum()) + 1, len(removal))


def _along_curve(position: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of a grid. It depends on the corner of the box around them, which has changed if outer ones are gone."""
    some = position[:, rows]
    return rows[np.argsort(morton(some - some.min(axis=1, keepdims=True)), kind="stable")]
