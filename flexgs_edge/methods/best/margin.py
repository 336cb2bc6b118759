"""`--views-margin`: poses that nobody took are scored as well, nearer to what is seen, farther from it and in between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import at_distance, between
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.depths import visible_depths

NEARER, FARTHER = 0.5, 2.0
"""Distances of the poses that we make, as parts of their own pose's. They come on top of the given ones: in their place
they make files larger. Scenes differ in what is missing, so there are nearer and farther ones:
docs/results/tuning.md#nearer"""
BETWEEN, FAR = 8, 2
"""One of so many given poses has one half way to the nearest pose in the place of a nearer one, or a farther one as well."""


def with_margin(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of `cameras` to score, the first ones, and three made from every two of them.

    One from each is `NEARER`, but of eight one is half way to the nearest pose instead; one from every second is `FARTHER`.

    Parameters
    ----------
    renderer : Renderer
        With nothing loaded.
    source : SceneSource
        The original.
    cameras : sequence of Camera
        All training poses, the most important first.
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
