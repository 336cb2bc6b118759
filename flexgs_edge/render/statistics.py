"""Sums over views for each Gaussian: how many pixels it touches, and how much it contributes to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import FIXED_WEIGHT


@dataclass
class Statistics:
    """Sums over the views added so far, one entry for each row of the scene.

    Attributes
    ----------
    hits : np.ndarray
        [N] i64, pixels that the Gaussian was blended into.
    weights : np.ndarray
        [N] u64, sum of alpha T over pixels, in fixed point with units of 1 / `FIXED_WEIGHT`. Integers add exactly, so
        any order of views, chunks and workers gives the same bits.
    """

    hits: np.ndarray
    weights: np.ndarray

    @classmethod
    def zeros(cls, count: int) -> Statistics:
        """Statistics before the first view: all zero."""
        return cls(np.zeros(count, np.int64), np.zeros(count, np.uint64))

    @property
    def weight_sums(self) -> np.ndarray:
        """[N] f64, sum of alpha T over pixels."""
        return self.weights / FIXED_WEIGHT
