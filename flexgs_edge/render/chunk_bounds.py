"""Which chunks of a scene a view can see: a box around a chunk's means, and how far its splats reach beyond them.

A chunk is left out only where `project` would cull each of its rows. In pixels a splat reaches by at most
s f sqrt(1 + u^2) / z for its largest standard deviation s, and by what the dilation adds; times z, each side of the picture
becomes a half-space of scene units, and a linear function is largest at a corner of the box.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import EXTENT_SLACK, LOG2_255, SIGMA_RADIUS_INRIA, TILE

SIGMAS = math.sqrt((LOG2_255 + EXTENT_SLACK) * 2.0 * math.log(2.0))
"""Standard deviations that an opaque splat reaches in the exact ellipse."""
INRIA_SPREAD = math.sqrt(math.sqrt(0.1))
"""What the floor of 0.1 in the larger eigenvalue adds to its root, at most."""
ROUNDING = 1e-5
"""Share of the largest term that float32 may be off by in `project`: a hundred times what it is."""
LARGER = 1.001
"""The same for extents."""


@dataclass(frozen=True)
class ChunkBounds:
    """A chunk of a scene.

    Parameters
    ----------
    middle, half : np.ndarray
        [3] f64, of the box around its means, scene units relative to the origin.
    extent : float
        Largest standard deviation of a row along any axis of its own.
    """

    middle: np.ndarray
    half: np.ndarray
    extent: float

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> ChunkBounds:
        """Of rows with these stored values ([3, n] f32 each, n > 0); what is not finite is seen by every view."""
        low, high = means.min(axis=1).astype(np.float64), means.max(axis=1).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return cls((low + high) / 2, (high - low) / 2, LARGER * float(np.exp(np.float64(log_scales.max()))))

    def seen(self, record: np.ndarray, inria_extent: bool) -> bool:
        """Whether a view may show a row: `record` is its camera's ([32] f32, from `camera_record`)."""
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
