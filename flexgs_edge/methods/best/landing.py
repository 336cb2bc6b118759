"""Brings a result that is a little too large to the size that was asked for, without making it anew."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.storage import Storage
from flexgs_edge.scene.curve import morton

REACH = 0.04
"""Largest log of size over limit that is landed. Beyond it, a new result at another multiplier is better."""
NEAR = 0.002
"""How far below the limit, as a share of it, we are content."""
TRIES = 4
"""Most times that the file is coded on the way."""


def land(
    grid: GridScene, removal: np.ndarray, size: int, limit: int, size_of: Callable[[GridScene], int], storage: Storage
) -> tuple[GridScene, int]:
    """Remove the Gaussians whose removal costs least, until the file just fits.

    Parameters
    ----------
    grid : GridScene
        The result.
    removal : np.ndarray
        [n] f64, cost of the removal of each of its rows.
    size : int
        Its bytes.
    limit : int
        Most bytes.
    size_of : callable
        Bytes of a grid's file.
    storage : Storage
        Holds the new grid.

    Returns
    -------
    tuple
        The grid and its bytes; those that were given if it fits already, is too large for this, or cannot be made to fit.
    """
    if not 0.0 < math.log(size / limit) <= REACH:
        return grid, size
    cheapest = np.argsort(removal, kind="stable")
    landed, fits, out = None, grid.count, 0
    # Bytes of a row: at first the mean, then what the rows removed so far have taken.
    each = size / grid.count
    wanted = limit * (1 - NEAR / 2)
    count, last = 0, size
    for _ in range(TRIES):
        count = min(max(count + math.ceil((last - wanted) / each), out + 1), fits - 1)
        if count <= out:
            break
        smaller = grid.take(_along_curve(grid.position, np.sort(cheapest[count:])), storage)
        last = size_of(smaller)
        if last <= limit:
            landed, fits = (smaller, last), count
            if last >= (1 - NEAR) * limit:
                break
        else:
            out = count
        each = max((size - last) / count, each / 4)
    return landed or (grid, size)


def _along_curve(position: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows in the order of a grid. It depends on the corner of the box around them, which has changed if outer ones are gone."""
    some = position[:, rows]
    return rows[np.argsort(morton(some - some.min(axis=1, keepdims=True)), kind="stable")]
