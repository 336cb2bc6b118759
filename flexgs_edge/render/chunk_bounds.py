"""Bounds of blocks of rows, to skip those that a view cannot see: a box around the means, and how far the splats reach.

A block may be skipped only if `project` would cull each of its rows. A splat reaches at most s f sqrt(1 + u^2) / z
pixels for its largest standard deviation s, plus the dilation. Multiplied by z, each side of the picture becomes a
half-space in scene units. A linear function is largest at a corner of the box, so the corners decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import EXTENT_SLACK, LOG2_255, ROW_BLOCK

SIGMAS = math.sqrt((LOG2_255 + EXTENT_SLACK) * 2.0 * math.log(2.0))
"""Standard deviations that the ellipse of an opaque splat reaches."""
ROUNDING = 1e-5
"""Bound of the float32 error in `project`, as a share of the largest term: generous, so that no block vanishes by
rounding."""
LARGER = 1.001  # Factor that widens the extent of a block against rounding


@dataclass(frozen=True)
class ChunkBounds:
    """Bounds of the blocks of one chunk of a scene: ROW_BLOCK rows each, in row order.

    `middle`, `half`: [3, blocks] f64, centre and half size of the box around the means, scene units relative to the
    origin.
    """

    middle: np.ndarray
    half: np.ndarray
    # [blocks] f64, largest standard deviation of any Gaussian along any of its own axes, scene units.
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

    def seen(self, record: np.ndarray) -> np.ndarray:
        """[blocks] bool, whether a view may show a row of each block; `record` is its `camera_record` ([32] f32)."""
        camera = record.astype(np.float64)
        rotation, shift = camera[:9].reshape(3, 3), camera[9:12]
        (fx, fy, cx, cy), (width, height), dilation = camera[12:16], camera[24:26], camera[26]
        slopes = [math.hypot(1.0, np.abs(camera[at : at + 2]).max()) for at in (17, 19)]
        with np.errstate(over="ignore", invalid="ignore"):
            # Reach: `spread` times the extent at depth 1, in scene units, and `pixels` at any.
            spread = [SIGMAS * abs(f) * slope for f, slope in zip((fx, fy), slopes, strict=True)]
            pixels = SIGMAS * math.sqrt(dilation)
            # The sides of the picture, near plane first: its axis, and the factors of x or y and of depth.
            axis = [0, 0, 0, 1, 1]
            across = np.array([0.0, fx, -fx, fy, -fy])
            deep = np.array([1.0, cx + 1 + pixels, width - cx + pixels, cy + 1 + pixels, height - cy + pixels])
            room = np.empty((len(axis), len(self.extent)))
            room[0], room[1:] = -camera[16], np.outer(np.repeat(spread, 2), self.extent)
            # Their values at the middles of the boxes, and how much more at the corner where they are largest.
            factors = across[:, None] * rotation[axis] + deep[:, None] * rotation[2]
            offsets = across * shift[axis] + deep * shift[2]
            most = factors @ self.middle + np.abs(factors) @ self.half + room + offsets[:, None]
            # The sizes of all terms bound how much is rounded.
            sizes = np.abs(across)[:, None] * np.abs(rotation[axis]) + np.abs(deep)[:, None] * np.abs(rotation[2])
            constant = np.abs(across * shift[axis]) + np.abs(deep * shift[2])
            terms = sizes @ (np.abs(self.middle) + self.half) + np.abs(room) + constant[:, None]
            outside: np.ndarray = (most < -ROUNDING * terms).any(axis=0)
        return ~outside
