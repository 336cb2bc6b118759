"""Generate camera poses from given ones: closer, farther, and in between."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.small_matrices import nearest_rotation, product

NEARER, FARTHER = 0.5, 2.0
"""Distances of made poses from the scene, in distances of the given pose. Scenes differ in which views are missing, so we
make both kinds: docs/results/tuning.md#nearer"""
LEAST_ALIKE = 0.7
"""Least cosine between two directions of view (45 degrees). Beyond it, the middle view would see what neither of the
two sees."""


def at_distance(camera: Camera, depth: float, factor: float) -> Camera:
    """The camera moved along its axis, to `factor` times its distance from the things at `depth`."""
    # Along the camera's own axis, only the z part of the translation changes.
    moved = camera.translation + np.array([0.0, 0.0, (factor - 1) * depth])
    return replace(camera, name=f"{camera.name} at {factor:g}x", translation=moved)


def between(first: Camera, second: Camera) -> Camera:
    """The camera half way between two, with the lens of the first; its rotation is the nearest one to the mean."""
    rotation = nearest_rotation(first.rotation + second.rotation)
    if not np.isfinite(rotation).all():
        rotation = first.rotation  # they are half a turn apart, and no rotation is nearest
    center = (first.center + second.center) / 2
    return replace(
        first, name=f"{first.name} to {second.name}", rotation=rotation, translation=product(-rotation, center)
    )


def poses_between(cameras: Sequence[Camera]) -> list[Camera]:
    """Generate cameras half way between each camera and its nearest neighbour that looks in about the same direction.

    Each pair gives one camera; see `between`.
    """
    centres = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    ahead = np.array([camera.rotation[2] for camera in cameras]).reshape(-1, 3)
    pairs: dict[tuple[int, int], None] = {}
    for i in range(len(cameras)):
        away = np.square(centres - centres[i]).sum(axis=1)
        away[product(ahead, ahead[i]) < LEAST_ALIKE] = np.inf
        away[i] = np.inf
        nearest = int(np.argmin(away))
        if 0.0 < away[nearest] < np.inf:
            pairs[min(i, nearest), max(i, nearest)] = None
    return [between(cameras[i], cameras[k]) for i, k in pairs]
