"""`--views-margin`: poses that nobody took are scored as well, nearer to what is seen, farther from it and in between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.made import at_distance, between
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.depths import visible_depths

NEARER, FARTHER = 0.5, 2.0
"""Distances of poses that are made, as parts of their own pose's. They come on top: in the place of 16 of 48 given ones they cost
fox 22 % of its bytes.

Scenes differ in what is missing: at the default target without any the sample (fast) is 5.0 dB below its training poses' fidelity
at half the distance and 1.5 at twice, fox 0.8 and 7.6. One nearer for each given pose, and one farther for every second, leave
2.4 dB of the sample and 2.2 of fox. With one for each pose, five of eight nearer and two farther, it was 2.7 and 4.0; three and
four, 3.7 and 1.7; one of both for each pose 1.1 on fox, for 7 % more bytes. docs/guards.md has all figures."""
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
