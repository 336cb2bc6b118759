"""Tell whether two small pictures show the same thing, whatever their exposure, blur and noise.

The measure is the normalised cross-correlation of what lies between two scales: noise and fine texture are smoothed away, and
so is light that changes slowly. Pictures of the same thing are near 1. Others are near 0, also where sky and ground are alike.
"""

from __future__ import annotations

import math

import numpy as np

SIDE = 96
"""Pixels of the longer side of the pictures that are compared."""
FINE, COARSE = 1, 6
"""Half sides of the windows of both scales, pixels."""
PLAIN = 0.25 / 255.0
"""A picture whose details have less than this root mean square shows nothing that could be compared."""


def details(image: np.ndarray) -> np.ndarray | None:
    """What lies between the two scales of a picture, at unit norm; `None` for a picture that shows nothing.

    `image`: [H, W, 3] f32, `SIDE` pixels on the longer side. Returns [H, W, 3] f32.
    """
    smooth = _window_mean(_window_mean(np.clip(image, 0.0, 1.0).astype(np.float64), FINE), FINE)
    found = smooth - _window_mean(smooth, COARSE)
    found -= found.mean(axis=(0, 1))
    norm = math.sqrt(float(np.square(found).sum()))
    return None if norm < PLAIN * math.sqrt(found.size) else (found / norm).astype(np.float32)


def likeness(first: np.ndarray | None, second: np.ndarray | None) -> float:
    """Correlation of the details of two pictures, -1 to 1; 0 if one of them shows nothing, or if their sizes differ."""
    if first is None or second is None or first.shape != second.shape:
        return 0.0
    return float(np.vdot(first, second))


def _window_mean(planes: np.ndarray, reach: int) -> np.ndarray:
    """Mean over windows of `2 reach + 1` pixels a side, which are cut off at the edges."""
    for axis in (0, 1):
        size = planes.shape[axis]
        first = np.maximum(np.arange(size) - reach, 0)
        behind = np.minimum(np.arange(size) + reach + 1, size)
        sums = np.concatenate([np.zeros_like(planes.take([0], axis)), planes.cumsum(axis)], axis)
        shape = [1, 1, 1]
        shape[axis] = size
        planes = (sums.take(behind, axis) - sums.take(first, axis)) / (behind - first).reshape(shape)
    return planes
