"""Sums over views for each Gaussian: how many pixels it touches, and how much it contributes to them."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.constants import FIXED_WEIGHT, SUM_LANES
from flexgs_edge.kernels.backend import Backend

SUM_ROWS = 1 << 18  # Rows of sums that are copied to the host at a time
GROUP_ROWS = 1 << 12
"""Rows of sums over views that are copied at a time, a multiple of `SUM_LANES`: few enough for a core's cache."""


@dataclass
class Statistics:
    """Sums over the views added so far, one entry for each row of the scene."""

    hits: np.ndarray  # [N] i64, pixels that the Gaussian was blended into
    # [N] u64, sum of alpha T over pixels, in fixed point with units of 1 / `FIXED_WEIGHT`. Integers add exactly, so any
    # order of views, chunks and workers gives the same bits.
    weights: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> "Statistics":
        """Statistics before the first view: all zero."""
        return cls(np.zeros(count, np.int64), np.zeros(count, np.uint64))

    @property
    def weight_sums(self) -> np.ndarray:
        """[N] f64, sum of alpha T over pixels."""
        return self.weights / FIXED_WEIGHT


def planes_of(backend: Backend, sums: Any, count: int) -> Iterator[tuple[slice, np.ndarray]]:
    """Read sums over views, which lie in groups, part by part.

    `sums`: [groups, ..., SUM_LANES], sums of a group of rows for each plane. `count`: how many rows to read. Yields
    `rows`: rows : slice. `planes`: [planes, rows], valid until the next step.
    """
    planes = int(np.prod(sums.shape[1:-1]))
    lanes = np.dtype((np.void, SUM_LANES * np.dtype(sums.dtype).itemsize))
    groups = min(GROUP_ROWS // SUM_LANES, sums.shape[0])
    held, turned = np.empty((groups, planes, SUM_LANES), sums.dtype), np.empty((planes, groups, SUM_LANES), sums.dtype)
    for first in range(0, count, GROUP_ROWS):
        rows = slice(first, min(first + GROUP_ROWS, count))
        some = -(-(rows.stop - first) // SUM_LANES)
        backend.read(sums, held[:some], first * planes)
        # Lanes that are copied as one element are copied much faster.
        turned.view(lanes)[:, :some, 0] = held.view(lanes)[:some, :, 0].T
        yield rows, turned.reshape(planes, -1)[:, : rows.stop - first]


class SumReader:
    """Copies sums of views to the host."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self._words = np.empty(0, np.uint32)
        """Kept from view to view: fresh pages for each one take as long as the copy."""

    def first_plane(self, sums: Any, count: int) -> np.ndarray:
        """[count] u64, the first plane of the first `count` rows of `sums` ([., planes, 2] u32)."""
        planes, values = sums.shape[1], np.empty(count, np.uint64)
        size = min(SUM_ROWS, count) * planes * 2
        if self._words.size < size:
            self._words = np.empty(size, np.uint32)
        for base in range(0, count, SUM_ROWS):
            rows = min(SUM_ROWS, count - base)
            words = self._words[: rows * planes * 2].reshape(rows, planes, 2)
            self._backend.read(sums, words, 2 * planes * base)
            values[base : base + rows] = words.view(np.uint64)[:, 0, 0]
        return values

    def release(self) -> None:
        """Free the memory that is kept."""
        self._words = np.empty(0, np.uint32)
