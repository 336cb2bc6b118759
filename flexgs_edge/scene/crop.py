"""A part of a scene: the Gaussians of which at least half lies inside of a box or a sphere."""

from dataclasses import dataclass, replace
from itertools import product as combinations
from typing import Any

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.scene.rotations import matrices
from flexgs_edge.scene.source import Planes, SceneSource, SelectSource

GEOMETRY = ("means", "log_scales", "quats")
LEAST_INSIDE = 0.5
LOGISTIC = 1.702  # 1 / (1 + exp(-1.702 x)) is within 0.01 of the normal distribution


@dataclass(frozen=True)
class Crop:
    """A box, or a sphere, in the world coordinates of the scene's PLY (x right, y down, z forward)."""

    centre: tuple[float, ...]  # 3 numbers
    half: tuple[float, ...]  # half the edges of a box, or three times the radius of a sphere
    axes: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))  # directions of the edges
    sphere: bool = False

    def to_json(self) -> dict[str, Any]:
        """What `crop_of` reads."""
        if self.sphere:
            return {"center": list(self.centre), "radius": self.half[0]}
        size = [2 * edge for edge in self.half]
        return {"center": list(self.centre), "size": size, "axes": [list(axis) for axis in self.axes]}

    def __str__(self) -> str:
        centre = ", ".join(f"{value:.6g}" for value in self.centre)
        if self.sphere:
            return f"the sphere of radius {self.half[0]:.6g} around {centre}"
        return f"the box of {' x '.join(f'{2 * edge:.6g}' for edge in self.half)} around {centre}"

    def turned(self, signs: tuple[int, ...]) -> "Crop":
        """In a frame whose axes have these directions (1 or -1 each)."""
        centre = tuple(value * sign for value, sign in zip(self.centre, signs, strict=True))
        axes = tuple(tuple(value * sign for value, sign in zip(axis, signs, strict=True)) for axis in self.axes)
        return replace(self, centre=centre, axes=axes)

    def inside(self, planes: Planes, origin: np.ndarray) -> np.ndarray:
        """[n] bool: at least half of a Gaussian's matter lies inside.

        `planes`: stored `means`, `log_scales` and `quats`. `origin`: as in `SceneSource`. The shares along the three axes are
        multiplied; of a sphere, they are those along the way to its centre and beside it.
        """
        means, log_scales, quats = (planes[name].astype(np.float64) for name in GEOMETRY)
        axes, half = np.array(self.axes), np.array(self.half)[:, None]
        away = axes @ (means + (origin - np.array(self.centre))[:, None])
        # A Gaussian's deviation along an axis: the length of the axis in its own axes, each times its scale.
        own = np.einsum("nji,kj->nki", matrices(quats), axes) * np.exp(log_scales.T[:, None, :])
        if self.sphere:
            distance = np.sqrt((away * away).sum(axis=0))
            ahead = np.where(distance > 0, away / np.maximum(distance, 1e-300), np.array([[1.0], [0.0], [0.0]]))
            deviation = np.sqrt(np.square(np.einsum("nki,kn->ni", own, ahead)).sum(axis=1))
            across = np.sqrt(np.maximum((np.square(own).sum(axis=(1, 2)) - deviation**2) / 2, 0.0))
            beside = _share(np.zeros_like(distance), half[0], across)
            return np.asarray(_share(distance, half[0], deviation) * beside * beside >= LEAST_INSIDE)
        deviations = np.sqrt(np.square(own).sum(axis=2)).T
        return np.asarray(np.prod(_share(away, half, deviations), axis=0) >= LEAST_INSIDE)


def _share(away: np.ndarray, half: np.ndarray, deviation: np.ndarray) -> np.ndarray:
    """The share of a normal distribution within `half` of zero, if its mean is `away` from zero."""
    deviation = np.maximum(deviation, 1e-300)
    upper, lower = (np.clip((end - away) / deviation, -400, 400) for end in (half, -half))
    return np.asarray(1 / (1 + np.exp(-LOGISTIC * upper)) - 1 / (1 + np.exp(-LOGISTIC * lower)))


def cropped(source: SceneSource, crop: Crop, chunk_rows: int = 65536) -> SceneSource:
    """The Gaussians of `source` that lie inside. Raises `InputError` if there are none; the message has the scene's bounds."""
    keep = np.zeros(source.count, bool)
    for rows in source.chunks(chunk_rows):
        keep[rows] = crop.inside(source.read(rows, GEOMETRY), source.origin)
    if not keep.any():
        raise _empty(source, crop, chunk_rows)
    note = f"cropped to {crop}: {np.count_nonzero(keep)} of {source.count} Gaussians lie inside"
    return SelectSource(source, np.flatnonzero(keep), (note,))


def usual_bounds(positions: np.ndarray) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Lowest and highest corner of the box that holds nine tenths of positions ([3, n]) along each axis."""
    low, high = (tuple(np.quantile(positions, share, axis=1).tolist()) for share in (0.05, 0.95))
    return low, high


def _empty(source: SceneSource, crop: Crop, chunk_rows: int) -> InputError:
    """The error for a crop that holds nothing: where the scene lies, and the frame in which the crop would hold most of it."""
    sample = source.read(np.arange(0, source.count, max(source.count // chunk_rows, 1)), GEOMETRY)
    places = sample["means"].astype(np.float64) + source.origin[:, None]
    bounds = " to ".join(", ".join(f"{value:.4g}" for value in corner) for corner in usual_bounds(places))
    held = {
        signs: int(np.count_nonzero(crop.turned(signs).inside(sample, source.origin)))
        for signs in combinations((1, -1), repeat=3)
    }
    best = max(held, key=lambda signs: held[signs])
    hint = ""
    if held[best]:
        letters = "".join(pair[sign < 0] for pair, sign in zip(("RL", "DU", "FB"), best, strict=True))
        hint = (
            f". With axes that point as {letters} it holds {held[best] / places.shape[1]:.0%} of the scene: write it to a JSON "
            f'file with "frame": "{letters}"'
        )
    return InputError(
        f"--crop: {crop} holds none of {source.count} Gaussians; nine tenths of them lie within {bounds}{hint}"
    )
