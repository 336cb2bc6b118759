"""Bounds of a chunk, to skip chunks that a view cannot see: a box around its means, and how far its splats reach.

A chunk may be skipped only if `project` would cull each of its rows. A splat reaches at most s f sqrt(1 + u^2) / z
pixels for its largest standard deviation s, plus the dilation. Multiplied by z, each side of the picture becomes a
half-space in scene units. A linear function is largest at a corner of the box, so the corners decide.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import EXTENT_SLACK, LOG2_255, SIGMA_RADIUS_INRIA, TILE

SIGMAS = math.sqrt((LOG2_255 + EXTENT_SLACK) * 2.0 * math.log(2.0))
"""Standard deviations that the exact ellipse of an opaque splat reaches."""
INRIA_SPREAD = math.sqrt(math.sqrt(0.1))
"""Upper bound of what the floor of 0.1 adds to the square root of the larger eigenvalue."""
ROUNDING = 1e-5
"""Bound of the float32 error in `project`, as a share of the largest term: generous, so that no chunk vanishes by
rounding."""
LARGER = 1.001
"""Factor that widens the extent of a chunk against rounding."""


@dataclass(frozen=True)
class ChunkBounds:
    """Bounds of one chunk of a scene.

    Parameters
    ----------
    middle, half : np.ndarray
        [3] f64, centre and half size of the box around the means, scene units relative to the origin.
    extent : float
        Largest standard deviation of any Gaussian along any of its own axes, scene units.
    """

    middle: np.ndarray
    half: np.ndarray
    extent: float

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> ChunkBounds:
        """Bounds of rows with these stored values ([3, n] f32 each, n > 0).

        If one is not finite, every view sees the chunk.
        """
        low, high = means.min(axis=1).astype(np.float64), means.max(axis=1).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return cls((low + high) / 2, (high - low) / 2, LARGER * float(np.exp(np.float64(log_scales.max()))))

    def seen(self, record: np.ndarray, inria_extent: bool) -> bool:
        """Whether a view may show a row of the chunk; `record` is its `camera_record` ([32] f32)."""
        camera = record.astype(np.float64)
        rotation, shift = camera[:9].reshape(3, 3), camera[9:12]
        (fx, fy, cx, cy), (width, height), dilation = camera[12:16], camera[24:26], camera[26]
        slopes = [math.hypot(1.0, np.abs(camera[at : at + 2]).max()) for at in (17, 19)]
        # Reach: `spread` scene units at depth 1, and `pixels` at any.
        spread = [SIGMAS * self.extent * abs(f) * slope for f, slope in zip((fx, fy), slopes, strict=True)]
        pixels = SIGMAS * math.sqrt(dilation)
        if inria_extent:
            spread = [SIGMA_RADIUS_INRIA / SIGMAS * sum(spread)] * 2
            pixels = SIGMA_RADIUS_INRIA * (2 * math.sqrt(dilation) + INRIA_SPREAD) + 1 + TILE
        sides = (
            (0.0, 1.0, -camera[16]),
            (fx, cx + 1 + pixels, spread[0]),
            (-fx, width - cx + pixels, spread[0]),
            (fy, cy + 1 + pixels, spread[1]),
            (-fy, height - cy + pixels, spread[1]),
        )
        for place, (across, deep, room) in enumerate(sides):
            axis = 0 if place < 3 else 1
            normal = across * rotation[axis] + deep * rotation[2]
            most = normal @ self.middle + np.abs(normal) @ self.half + across * shift[axis] + deep * shift[2] + room
            corner = np.abs(self.middle) + self.half
            terms = [abs(f) * (np.abs(rotation[i]) @ corner + abs(shift[i])) for f, i in ((across, axis), (deep, 2))]
            if most < -ROUNDING * (sum(terms) + abs(room)):
                return False
        return True
