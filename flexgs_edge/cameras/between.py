"""Poses between given ones: views that nobody scored, of what is there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.camera import Camera

LEAST_ALIKE = 0.7
"""Cosine of the angle between two directions of view (45 degrees): beyond it the middle sees what neither of the two does."""


def poses_between(cameras: Sequence[Camera]) -> list[Camera]:
    """A camera halfway between each camera and the nearest one that looks in about the same direction, each pair once.

    Places and rotations are means, the image is that of the first of the two.
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
    return [_middle(cameras[i], cameras[k]) for i, k in pairs]


def _middle(one: Camera, other: Camera) -> Camera:
    left, _, right = np.linalg.svd(one.rotation + other.rotation)
    rotation = left @ right
    centre = (one.center + other.center) / 2
    return replace(one, name=f"{one.name}+{other.name}", rotation=rotation, translation=-rotation @ centre)
