"""Order cameras so that the first ones of any number cover the whole scene, by what they see."""

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.small_matrices import product

GAIN_DIGITS = 4  # Decimals in comparisons of what a camera adds, as a share of all points
SAME_VIEW = 0.2
"""Two views of a point overlap if the cosine between their directions differs from 1 by less than this: up to 37
degrees. A wider reach would leave out views that are needed: docs/results/tuning.md#same_view"""
MOST_PAIRS = 1 << 21  # Most pairs of a camera and a point. With more cameras than fit, we look at fewer points.
DIGITS = 8  # Decimals in comparisons of squared distances, so that rounding does not break ties
BESIDE_EACH_OTHER = 2.0
"""Squared distance of two directions at a right angle. A camera that is farther turned looks the other way."""


def covering_order(cameras: Sequence[Camera], points: np.ndarray, near: float, count: int) -> list[int]:
    """Choose at most `count` cameras, each next one with the most to add to what the chosen ones see.

    It returns their indices. A point adds 1 to a camera that has it in its picture; occlusion is ignored. It adds less
    for every chosen camera that has it from a near direction: 1 / (1 + sum of max(0, 1 - (1 - cosine) / `SAME_VIEW`)).
    Ties go to the lower index.

    `points`: [3, n] f64, a sample of the scene's positions, world coordinates. `near`: near plane, scene units.
    `count`: most cameras to choose.
    """
    if not cameras:
        return []
    points = points[:, :: max(-(-len(cameras) * points.shape[1] // MOST_PAIRS), 1)]
    known: dict[int, tuple[int, np.ndarray]] = {}  # How many chosen cameras were added up for some, and their sums
    chosen: list[tuple[np.ndarray, np.ndarray]] = []
    order: list[int] = []

    def lines(index: int) -> tuple[np.ndarray, np.ndarray]:
        away = points - cameras[index].center[:, None]
        away /= np.maximum(np.linalg.norm(away, axis=0, keepdims=True), np.finfo(np.float64).tiny)
        return in_picture(cameras[index], points, near), away

    def gain(index: int) -> float:
        seen, away = lines(index)
        number, sums = known.get(index, (0, np.zeros(points.shape[1])))
        for other, beside in chosen[number:]:
            sums += other * np.maximum(1.0 - (1.0 - (away * beside).sum(axis=0)) / SAME_VIEW, 0.0)
        known[index] = len(chosen), sums
        return float((np.where(seen, 1.0 / (1.0 + sums), 0.0).sum() / max(points.shape[1], 1)).round(GAIN_DIGITS))

    # The gain of a camera only falls, so an older gain is an upper bound. Few cameras are looked at again for each one.
    bounds = np.full(len(cameras), np.inf)
    while len(order) < min(count, len(cameras)):
        fresh = np.zeros(len(cameras), bool)
        while not fresh[best := int(np.argmax(bounds))]:
            bounds[best], fresh[best] = gain(best), True
        order.append(best)
        chosen.append(lines(best))
        bounds[best] = -1.0
    return order


def in_picture(camera: Camera, points: np.ndarray, near: float) -> np.ndarray:
    """[n] bool, the points ([3, n] f64) that project into the picture of a camera."""
    x, y, z = product(camera.rotation, points) + camera.translation[:, None]
    with np.errstate(all="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
        inside: np.ndarray = (z > near) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    return inside


def squared_distances(cameras: Sequence[Camera], others: Sequence[Camera]) -> np.ndarray:
    """[m, n] f64, of m cameras from n others, with one of those at least.

    The squared distance of their places, in mean squared distances of the others from their middle, plus that of their
    directions.
    """
    centres = np.stack([other.center for other in others])
    spread = float(np.sqrt(np.square(centres - centres.mean(axis=0)).sum(axis=1).mean())) or 1.0

    def places(views: Sequence[Camera]) -> np.ndarray:
        return np.stack([np.concatenate([camera.center / spread, camera.rotation[2]]) for camera in views])

    return np.square(places(cameras)[:, None] - places(others)[None]).sum(axis=2)


def nearest(camera: Camera, others: Sequence[Camera], count: int) -> list[int]:
    """Places of at most `count` cameras nearest to one, the nearest first; those that look the other way do not count."""
    if not others:
        return []
    ahead = np.stack([other.rotation[2] for other in others])
    turned = np.square(ahead - camera.rotation[2]).sum(axis=1)
    order = np.argsort(squared_distances([camera], others)[0].round(DIGITS), kind="stable")
    return [int(place) for place in order if others[place] is not camera and turned[place] < BESIDE_EACH_OTHER][:count]
