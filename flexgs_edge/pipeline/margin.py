"""`--views-margin`: poses that nobody took are scored as well, nearer to what is seen, farther from it and in between."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.cameras.made import at_distance, between
from flexgs_edge.render import Renderer
from flexgs_edge.render.depths import visible_depths
from flexgs_edge.scene import SceneSource

NEARER, FARTHER = 0.5, 2.0
"""Distances of poses that are made, as parts of their own pose's. They come on top: in the place of 16 of 48 given ones they cost
fox 22 % of its bytes. One for each given pose, since half as many left the sample (balanced) 3.6 dB below its training poses'
fidelity at half the distance, where none leaves it 5.1 dB and this 2.9 dB; docs/guards.md has all figures."""
BETWEEN, FAR = 3, (2, 6)
"""Turns, of eight, of the other kinds."""


def with_margin(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera], most: int) -> list[Camera]:
    """At most `most` of `cameras` to score, the first ones, and one made from each of them.

    Of eight that are made five are `NEARER`, two `FARTHER` and one is half way to the nearest pose, each from another pose.

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
        turn = place % 8
        others = [other for other in cameras if other is not camera]
        if turn == BETWEEN and others:
            away = [float(np.linalg.norm(other.center - camera.center)) for other in others]
            made.append(between(camera, others[int(np.argmin(away))]))
        else:
            made.append(at_distance(camera, depth, FARTHER if turn in FAR else NEARER))
    return real + made
