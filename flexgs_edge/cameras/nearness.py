"""How near cameras are to each other, by where they are and where they look."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera

DIGITS = 8  # Decimals in comparisons of squared distances, so that rounding does not break ties
BESIDE_EACH_OTHER = 2.0
"""Squared distance of two directions at a right angle. A camera that is farther turned looks the other way."""


def squared_distances(cameras: Sequence[Camera], others: Sequence[Camera]) -> np.ndarray:
    """[m, n] f64, of m cameras from n others, with one of those at least.

    The squared distance of their places, in mean squared distances of the others from their middle, plus that of their
    directions.
    """
    centres = np.stack([other.center for other in others])
    spread = float(np.sqrt(np.square(centres - centres.mean(axis=0)).sum(axis=1).mean())) or 1.0

    def places(views: Sequence[Camera]) -> np.ndarray:
        return np.stack([np.concatenate([camera.center / spread, camera.rotation[2]]) for camera in views])

    found: np.ndarray = np.square(places(cameras)[:, None] - places(others)[None]).sum(axis=2)
    return found


def nearest(camera: Camera, others: Sequence[Camera], count: int) -> list[int]:
    """Places of at most `count` cameras nearest to one, the nearest first; those that look the other way do not count."""
    if not others:
        return []
    ahead = np.stack([other.rotation[2] for other in others])
    turned = np.square(ahead - camera.rotation[2]).sum(axis=1)
    order = np.argsort(squared_distances([camera], others)[0].round(DIGITS), kind="stable")
    return [int(place) for place in order if others[place] is not camera and turned[place] < BESIDE_EACH_OTHER][:count]
