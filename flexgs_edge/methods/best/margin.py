"""`--views-margin`: generated poses are scored too: closer to the scene, farther from it, and between given poses.

They protect Gaussians that matter only from such views. This makes files slightly larger, and scoring slower.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import FARTHER, NEARER, at_distance, between
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.depths import visible_depths

EVERY, BETWEEN = 8, 7
"""Of `EVERY` given poses, the first and fifth get a nearer one, the third and seventh a farther one, and number `BETWEEN` one
half way to its nearest neighbour: docs/results/tuning.md#margin. They come on top of the given poses; in place of them they
would make files larger."""
TIMES = {0: NEARER, 2: FARTHER, 4: NEARER, 6: FARTHER}


def margin_of(
    renderer: Renderer, source: SceneSource, poses: Sequence[Camera], cameras: Sequence[Camera]
) -> list[Camera]:
    """Five made poses for every eight.

    `renderer`: with nothing loaded. `source`: the original. `poses`: poses that are scored, the most important first.
    `cameras`: all training poses.
    """
    moved = [place for place in range(len(poses)) if place % EVERY in TIMES]
    depths = dict(zip(moved, visible_depths(renderer, source, [poses[place] for place in moved]), strict=True))
    made = []
    for place, camera in enumerate(poses):
        if place in depths:
            made.append(at_distance(camera, depths[place], TIMES[place % EVERY]))
        elif place % EVERY == BETWEEN and len(cameras) > 1:
            others = [other for other in cameras if other is not camera]
            away = [float(np.square(other.center - camera.center).sum()) for other in others]
            made.append(between(camera, others[int(np.argmin(away))]))
    return made
