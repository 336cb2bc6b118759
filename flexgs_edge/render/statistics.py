"""What a view adds up for each Gaussian: hits, weights and errors of removal."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import FIXED_WEIGHT


@dataclass
class Statistics:
    """Sums over the views added so far, one entry a row of the scene.

    Attributes
    ----------
    hits : np.ndarray
        [N] i64, pixels at which the Gaussian was blended.
    weights : np.ndarray
        [N] u64, sum of alpha T over pixels in fixed point, units of 1 / `FIXED_WEIGHT`: adding is exact, so any
        order of views, chunks and workers gives the same bits.
    """

    hits: np.ndarray
    weights: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> Statistics:
        """Statistics of no view."""
        return cls(np.zeros(count, np.int64), np.zeros(count, np.uint64))

    @property
    def weight_sums(self) -> np.ndarray:
        """[N] f64, sum of alpha T."""
        return self.weights / FIXED_WEIGHT
