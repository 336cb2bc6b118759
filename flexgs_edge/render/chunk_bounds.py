"""Bounds of blocks of rows, to skip those that a view cannot see: a box around the means, and how far the splats reach.

A block may be skipped only if `project` would cull each of its rows. A splat reaches at most s f sqrt(1 + u^2) / z
pixels for its largest standard deviation s, plus the dilation. Multiplied by z, each side of the picture becomes a
half-space in scene units. A linear function is largest at a corner of the box, so the corners decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import EXTENT_SLACK, LOG2_255, ROW_BLOCK, SIGMA_RADIUS_INRIA, TILE

SIGMAS = math.sqrt((LOG2_255 + EXTENT_SLACK) * 2.0 * math.log(2.0))
"""Standard deviations that the exact ellipse of an opaque splat reaches."""
INRIA_SPREAD = math.sqrt(math.sqrt(0.1))
"""Upper bound of what the floor of 0.1 adds to the square root of the larger eigenvalue."""
ROUNDING = 1e-5
"""Bound of the float32 error in `project`, as a share of the largest term: generous, so that no block vanishes by
rounding."""
LARGER = 1.001
"""Factor that widens the extent of a block against rounding."""


@dataclass(frozen=True)
class ChunkBounds:
    """Bounds of the blocks of one chunk of a scene: ROW_BLOCK rows each, in row order.

    Parameters
    ----------
    middle, half : np.ndarray
        [3, blocks] f64, centre and half size of the box around the means, scene units relative to the origin.
    extent : np.ndarray
        [blocks] f64, largest standard deviation of any Gaussian along any of its own axes, scene units.
    """

    middle: np.ndarray
    half: np.ndarray
    extent: np.ndarray

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> ChunkBounds:
        """Bounds of rows with these stored values ([3, n] f32 each, n > 0).

        If one is not finite, every view sees its block.
        """
        starts = np.arange(0, means.shape[1], ROW_BLOCK)
        low, high = (ends.reduceat(means, starts, axis=1).astype(np.float64) for ends in (np.minimum, np.maximum))
        largest = np.maximum.reduceat(log_scales, starts, axis=1).max(axis=0).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return cls((low + high) / 2, (high - low) / 2, LARGER * np.exp(largest))

    def seen(self, record: np.ndarray, inria_extent: bool) -> np.ndarray:
        """[blocks] bool, whether a view may show a row of each block; `record` is its `camera_record` ([32] f32)."""
        camera = record.astype(np.float64)
        rotation, shift = camera[:9].reshape(3, 3), camera[9:12]
        (fx, fy, cx, cy), (width, height), dilation = camera[12:16], camera[24:26], camera[26]
        slopes = [math.hypot(1.0, np.abs(camera[at : at + 2]).max()) for at in (17, 19)]
        none = np.zeros(len(self.extent))
        seen = np.ones(len(self.extent), bool)
        with np.errstate(over="ignore", invalid="ignore"):
            # Reach: `spread` scene units at depth 1, and `pixels` at any.
            spread = [SIGMAS * self.extent * abs(f) * slope for f, slope in zip((fx, fy), slopes, strict=True)]
            pixels = SIGMAS * math.sqrt(dilation)
            if inria_extent:
                spread = [SIGMA_RADIUS_INRIA / SIGMAS * (spread[0] + spread[1])] * 2
                pixels = SIGMA_RADIUS_INRIA * (2 * math.sqrt(dilation) + INRIA_SPREAD) + 1 + TILE
            sides = (
                (0.0, 1.0, none - camera[16]),
                (fx, cx + 1 + pixels, spread[0]),
                (-fx, width - cx + pixels, spread[0]),
                (fy, cy + 1 + pixels, spread[1]),
                (-fy, height - cy + pixels, spread[1]),
            )
            # Means and largest distances of the boxes along the axes of the camera.
            along, corner = rotation @ self.middle, np.abs(self.middle) + self.half
            far = np.abs(rotation) @ corner + np.abs(shift)[:, None]
            for place, (across, deep, room) in enumerate(sides):
                axis = 0 if place < 3 else 1
                reach = np.abs(across * rotation[axis] + deep * rotation[2]) @ self.half + room
                most = across * (along[axis] + shift[axis]) + deep * (along[2] + shift[2]) + reach
                terms = abs(across) * far[axis] + abs(deep) * far[2]
                seen &= ~(most < -ROUNDING * (terms + np.abs(room)))
        return seen
