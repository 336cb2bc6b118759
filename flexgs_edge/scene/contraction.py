"""Scene contraction: positions far from the centre come nearer, so that one grid holds near and far Gaussians.

Let m be a position's distance from the centre (the largest of three coordinates) over the radius. Positions of m <= 1 stay.
Others keep their direction, and get the distance k + m / 2^k with k = floor(log2 m): each doubling of m adds one radius. An
error of one grid step then grows with the distance, as views allow. Mip-NeRF 360 (Barron et al., CVPR 2022) contracts by
2 - 1 / m; a logarithm in straight pieces is undone by operations that every machine rounds alike.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

OCTAVES = 64  # Most doublings; what lies beyond is not contracted further
LARGEST = 2.0**126
"""Largest magnitude of coordinates that can be coded, and of radii and their reciprocals: nothing leaves float32 or float64."""
_SAMPLE, _FEWEST = 4096, 32  # Rows that tell the centre, and rows of its densest part


@dataclass(frozen=True)
class Contraction:
    """A contraction of positions."""

    centre: tuple[float, float, float]  # relative to the scene's origin
    radius: float  # positions within it stay as they are

    def contract(self, means: np.ndarray) -> np.ndarray:
        """[3, n] f64, contracted positions."""
        means = means.astype(np.float64)
        away = means - np.array(self.centre)[:, None]
        ratio = np.abs(away).max(axis=0) / self.radius
        far = np.flatnonzero(ratio > 1)
        m = ratio[far]
        k = np.minimum(np.frexp(m)[1] - 1, OCTAVES - 1)
        means[:, far] = np.array(self.centre)[:, None] + away[:, far] * ((k + np.ldexp(m, -k)) / m)
        return means

    def expand(self, means: np.ndarray) -> np.ndarray:
        """Undo `contract`, [3, n] f32; this is the specification of every decoder.

        All operations are float64, each is rounded once, and the results are rounded to float32.
        """
        centre = np.array(self.centre)[:, None]
        away = means.astype(np.float64) - centre
        contracted = np.abs(away).max(axis=0) / self.radius
        far = np.flatnonzero(contracted > 1)
        a = contracted[far]
        k = np.minimum(np.floor(a) - 1, OCTAVES - 1).astype(np.int32)
        expanded = centre + away[:, far] * (np.ldexp(a - k, k) / a)
        means = means.astype(np.float32)
        means[:, far] = np.clip(expanded, -LARGEST, LARGEST)
        return means

    def octaves(self, means: np.ndarray) -> np.ndarray:
        """[n] i64, floor(log2 m) of positions [3, n], inside the radius too; -`OCTAVES` at least."""
        away = np.abs(means.astype(np.float64) - np.array(self.centre)[:, None]).max(axis=0) / self.radius
        return np.frexp(np.maximum(away, 2.0**-OCTAVES))[1].astype(np.int64) - 1

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        return {"centre": list(self.centre), "radius": self.radius}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> "Contraction":
        """Inverse of `to_json`."""
        x, y, z = record["centre"]
        return cls((x, y, z), record["radius"])


def densest(means: np.ndarray) -> np.ndarray:
    """[3] f64, where positions [3, n] lie densest: on each axis the half-sample mode (Bickel & Fruehwirth 2006).

    Unlike a mean or a median, it stays in the scene when most Gaussians are a sky on one side.
    """
    count = means.shape[1]
    centre = np.zeros(3)
    for axis, values in enumerate(np.sort(means[:, :: max(count // _SAMPLE, 1)].astype(np.float64))):
        while len(values) > _FEWEST:
            half = len(values) // 2
            first = int(np.argmin(values[half:] - values[: len(values) - half]))
            values = values[first : first + half + 1]
        centre[axis] = np.median(values)
    return centre
