"""Poses in an order in which every beginning covers the whole: each next one is the farthest from those before it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera

DIGITS = 6
"""Decimals that squares of distances are told apart by: rounding of a scene that was moved must not break the ties of a rig."""


def farthest_order(cameras: Sequence[Camera]) -> list[int]:
    """Indices of all cameras, each next one farthest from those chosen; the first is the one nearest to their middle.

    Far is as the square root of two squares: of the distance of the places, over the mean distance from their middle, and of the
    distance of the directions looked in (two opposite ones are 2 apart), over the same mean of the directions. So neither
    a ring of cameras that look inwards nor a tripod that turns counts as one place. Ties go to the lower index.

    >>> from types import SimpleNamespace
    >>> line = [SimpleNamespace(center=np.array([x, 0.0, 0.0]), rotation=np.eye(3)) for x in (0.0, 1.0, 2.0, 3.0, 4.0)]
    >>> farthest_order(line)
    [2, 0, 4, 1, 3]
    """
    if not cameras:
        return []
    places = _spread(np.array([camera.center for camera in cameras]))
    points = np.hstack([places, _spread(np.array([camera.rotation[2] for camera in cameras]))])
    order = [int(np.argmin(np.square(points).sum(axis=1).round(DIGITS)))]
    nearest = np.full(len(points), np.inf)
    nearest[order] = -1.0
    while len(order) < len(points):
        nearest = np.minimum(nearest, np.square(points - points[order[-1]]).sum(axis=1))
        nearest[order] = -1.0
        order.append(int(np.argmax(nearest.round(DIGITS))))
    return order


def _spread(points: np.ndarray) -> np.ndarray:
    """[n, 3] about their middle, in units of their mean distance from it."""
    moved = points - points.mean(axis=0)
    unit = float(np.sqrt(np.square(moved).sum(axis=1)).mean())
    # Rounding alone must not decide where all stand in one place.
    return moved / unit if unit > 1e-9 * (1.0 + float(np.abs(points).max())) else np.zeros_like(moved)
