"""`--views-margin`: generated poses are scored too: closer to the scene, farther from it, and between given poses.

They protect Gaussians that matter only from such views. This makes files slightly larger, and scoring slower.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import at_distance, between
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.depths import visible_depths

NEARER, FARTHER = 0.5, 2.0
"""Distances of generated poses from the scene, in distances of the given pose. Generated poses come on top of the given
ones; in place of them they would make files larger. Scenes differ in which views are missing, so we make both kinds:
docs/results/tuning.md#nearer"""
BETWEEN, FAR = 8, 2
"""One of `BETWEEN` given poses gets a pose half way to its nearest neighbour instead of a nearer one. One of `FAR` given
poses gets a farther one too."""


def with_margin(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera], most: int) -> list[Camera]:
    """The first `most` of `cameras` to score, and three generated poses for every two of them.

    Each given pose gets a nearer one; one of eight gets one half way to its nearest neighbour instead. Every second
    pose also gets a farther one.

    Parameters
    ----------
    renderer : Renderer
        With nothing loaded.
    source : SceneSource
        The original.
    cameras : sequence of Camera
        All training poses, the most important first.
    most : int
        Most given poses.
    """
    real = list(cameras[:most])
    made = []
    for place, (camera, depth) in enumerate(zip(real, visible_depths(renderer, source, real))):
        others = [other for other in cameras if other is not camera]
        if place % BETWEEN == BETWEEN // 2 - 1 and others:
            away = [float(np.linalg.norm(other.center - camera.center)) for other in others]
            made.append(between(camera, others[int(np.argmin(away))]))
        else:
            made.append(at_distance(camera, depth, NEARER))
        if place % FAR == 0:
            made.append(at_distance(camera, depth, FARTHER))
    return real + made
