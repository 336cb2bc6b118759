"""Poses that nobody took, made from given ones."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera

LEAST_ALIKE = 0.7
"""Cosine of the angle between two directions of view (45 degrees): beyond it the middle sees what neither of the two does."""


def at_distance(camera: Camera, depth: float, factor: float) -> Camera:
    """The pose moved along its axis: `factor` times as far from what lies at `depth`."""
    # Along the camera's own axis only the third part of the translation changes.
    moved = camera.translation + np.array([0.0, 0.0, (factor - 1) * depth])
    return replace(camera, name=f"{camera.name} at {factor:g}x", translation=moved)


def between(first: Camera, second: Camera) -> Camera:
    """The pose half way between two, with the first one's lens: the middle of the places, the nearest rotation to the mean."""
    left, _, right = np.linalg.svd(first.rotation + second.rotation)
    rotation = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    center = (first.center + second.center) / 2
    return replace(first, name=f"{first.name} to {second.name}", rotation=rotation, translation=-rotation @ center)


def poses_between(cameras: Sequence[Camera]) -> list[Camera]:
    """A camera halfway between each camera and the nearest one that looks in about the same direction, each pair once.

    See `between`.
    """
    centres = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    ahead = np.array([camera.rotation[2] for camera in cameras]).reshape(-1, 3)
    pairs: dict[tuple[int, int], None] = {}
    for i in range(len(cameras)):
        away = np.square(centres - centres[i]).sum(axis=1)
        away[ahead @ ahead[i] < LEAST_ALIKE] = np.inf
        away[i] = np.inf
        nearest = int(np.argmin(away))
        if 0.0 < away[nearest] < np.inf:
            pairs[min(i, nearest), max(i, nearest)] = None
    return [between(cameras[i], cameras[k]) for i, k in pairs]
