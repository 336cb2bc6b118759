"""Places where a camera may stand: lattices in and around each part of a scene, and around single splats if it is sparse."""

from __future__ import annotations

import math

import numpy as np

from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.cameras.scene_sample import Part, SceneSample

MARGIN = 1.2
"""A lattice reaches so many half sides of its box to each side."""
WIDER = (1, 2, 4)
"""Lattices of a core, in half sides of its box. Cameras often stood outside the dense core that they looked at."""
BETWEEN = 1.5
"""Wider lattices end where they come this near to the size of the whole scene."""
CLOSE_UPS = 24
"""Splats that get places of their own, if the scene is sparse."""
CLOSE_SIDES = 4
"""Places around each of them."""
CLOSE_DISTANCE = 5.5
"""Distance of these places in deviations of the splat. Three deviations to each side then fill the frame."""
SPARSE = 0.5
"""A scene is sparse if all its cross-sections together are less than this share of a circle around its box."""


def first_places(scene: SceneSample, count: int) -> tuple[np.ndarray, np.ndarray]:
    """About `count` candidates in and around the parts of a scene.

    Returns positions relative to the scene's origin ([3, P] f64), and distances to the next ones ([P] f64, scene units).
    """
    boxes = _boxes(scene.parts)
    found = [_lattice(box, count / len(boxes)) for box in boxes]
    if is_sparse(scene):
        found.append(_close_ups(scene))
    return np.concatenate([at for at, _ in found], axis=1), np.concatenate([step for _, step in found])


def is_sparse(scene: SceneSample) -> bool:
    """Say if a view of the whole scene would be almost empty."""
    return scene.area < SPARSE * scene.whole.extent**2


def _boxes(parts: list[Part]) -> list[Part]:
    boxes = [parts[0]]
    for part in parts[1:]:
        for factor in WIDER:
            wider = Part(part.middle, part.half * factor)
            if factor == 1 or wider.extent * BETWEEN < parts[0].extent:
                boxes.append(wider)
    return boxes


def _lattice(box: Part, count: float) -> tuple[np.ndarray, np.ndarray]:
    """A cubic lattice of about `count` places in and around a box."""
    reach = (1 + MARGIN) * np.maximum(box.half, 0.25 * box.half.max())
    step = 2 * float(np.cbrt(reach.prod() / count))
    axes = []
    for half in reach:
        sides = max(1, round(2 * float(half) / step))
        axes.append((np.arange(sides) + 0.5) * (2 * float(half) / sides) - float(half))
    at = np.stack(np.meshgrid(*axes, indexing="ij")).reshape(3, -1) + box.middle[:, None]
    return at, np.full(at.shape[1], step)


def _close_ups(scene: SceneSample) -> tuple[np.ndarray, np.ndarray]:
    """Places around the splats that show most."""
    order = np.argsort(-scene.sample.opacity * scene.sample.sizes**2, kind="stable")[:CLOSE_UPS]
    distances = CLOSE_DISTANCE * scene.sample.sizes[order]
    offsets = fibonacci(CLOSE_SIDES).T
    at = scene.sample.means[:, order, None] + distances[:, None] * offsets[:, None]
    return at.reshape(3, -1), np.repeat(distances / math.sqrt(CLOSE_SIDES), CLOSE_SIDES)
