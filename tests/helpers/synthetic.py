"""Seeded generators of small scenes and cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, Planes, Rows

SIZES = ((1, 1), (15, 17), (16, 16), (17, 33), (1, 100))
"""Width and height at the borders of tiles and blocks."""


def make_camera(
    width: int = 40,
    height: int = 30,
    focal: float = 40.0,
    rotation: np.ndarray | None = None,
    translation: tuple[float, float, float] = (0.0, 0.0, 0.0),
    centre: tuple[float, float] | None = None,
    name: str = "view",
) -> Camera:
    """A camera that looks along +z from the origin unless told otherwise; the principal point defaults to the middle."""
    cx, cy = ((width - 1) / 2, (height - 1) / 2) if centre is None else centre
    turn = np.eye(3) if rotation is None else rotation
    return Camera(name, width, height, turn, np.array(translation), focal, focal * 1.1, cx, cy)


def look_from(seed: int) -> tuple[np.ndarray, tuple[float, float, float]]:
    """A rotation and translation that see the middle (0, 0, 4) of `random_scene` from somewhere else."""
    rng = np.random.default_rng(seed)
    angle, axis = rng.uniform(0.2, 0.7), rng.normal(size=3)
    x, y, z = axis / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    rotation = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    translation = np.array([0.1, -0.2, 4.5]) - rotation @ np.array([0.0, 0.0, 4.0])
    return rotation, (float(translation[0]), float(translation[1]), float(translation[2]))


def random_scene(
    count: int,
    seed: int = 0,
    degree: int = 0,
    size: float = -2.0,
    opacity: float = 0.0,
    spread: float = 1.2,
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> MemorySource:
    """Gaussians in a cloud around (0, 0, 4), quaternions of any norm.

    Parameters
    ----------
    size, opacity : float
        Means of the log-scales and of the opacity logits.
    spread : float
        Half width of the cloud in x and y, scene units.
    """
    rng = np.random.default_rng([seed, count])
    means = np.stack(
        [rng.uniform(-spread, spread, count), rng.uniform(-spread, spread, count), rng.uniform(2, 6, count)]
    )
    return MemorySource(
        {
            "means": means.astype(np.float32),
            "sh_dc": rng.normal(0, 1, (3, count)).astype(np.float32),
            "sh_rest": rng.normal(0, 0.3, (3 * sh_rest_count(degree), count)).astype(np.float32),
            "opacity_logits": rng.normal(opacity, 2, (1, count)).astype(np.float32),
            "log_scales": rng.normal(size, 0.7, (3, count)).astype(np.float32),
            "quats": (rng.normal(size=(4, count)) * rng.uniform(0.4, 1.8, count)).astype(np.float32),
        },
        degree,
        np.array(origin) if any(origin) else None,
    )


def make_splats(
    means: np.ndarray,
    deviations: np.ndarray,
    angles: np.ndarray | float = 0.0,
    opacity: np.ndarray | float = 0.9,
    colours: np.ndarray | None = None,
) -> MemorySource:
    """Gaussians with given standard deviations ([N, 3], scene units), turned about z by `angles` (radians).

    Parameters
    ----------
    means : np.ndarray
        [N, 3].
    opacity : np.ndarray or float
        In (0, 1).
    colours : np.ndarray, optional
        [N, 3], default white.
    """
    count = len(means)
    half = np.broadcast_to(np.asarray(angles, np.float64) / 2, count)
    alpha = np.broadcast_to(np.asarray(opacity, np.float64), count)
    colour = np.ones((count, 3)) if colours is None else colours
    arrays = {
        "means": np.asarray(means).T,
        "sh_dc": (np.asarray(colour).T - 0.5) / 0.28209479177387814,
        "opacity_logits": np.log(alpha / (1 - alpha))[None],
        "log_scales": np.log(np.asarray(deviations, np.float64)).T,
        "quats": np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)]),
    }
    return MemorySource({name: np.ascontiguousarray(values, np.float32) for name, values in arrays.items()})


class NotedSource(MemorySource):
    """A scene that notes which rows are read of it."""

    def __init__(self, scene: MemorySource) -> None:
        fields = [name for name in FIELD if scene.width(name)]
        super().__init__(scene.read(slice(0, scene.count), fields), scene.sh_degree, scene.origin)
        self.reads: list[Rows] = []

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        self.reads.append(rows)
        return super().read(rows, fields, out)


def joined(*sources: MemorySource) -> MemorySource:
    """Several scenes of one SH degree in one."""
    parts = [source.read(slice(0, source.count), list(FIELD)) for source in sources]
    return MemorySource({name: np.concatenate([part[name] for part in parts], axis=1) for name in FIELD})
