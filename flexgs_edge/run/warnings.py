"""Warnings of a run whose figures deserve less trust. Each names a number and what to do."""

from __future__ import annotations

import numpy as np

from flexgs_edge.goals.steps import Scored
from flexgs_edge.io.frames import RDF
from flexgs_edge.run.inputs import CheckedScene
from flexgs_edge.run.options import AUTO_CAMERAS
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.scene.source import some_positions
from flexgs_edge.small_matrices import product

FIT_GAP = 2.0  # We warn of overfitting when training views show this much more fidelity than held-out views, dB
NEEDED_VIEWS = 16  # We warn below this many scored views; more change little
UNSEEN_SHARE = 0.01  # We warn when automatic views miss more than this share of the Gaussians


BEHIND_SHARE = 0.5  # We warn when more than this share of the Gaussians lies behind all cameras
_SAMPLE_ROWS = 2048
_SAMPLE_VIEWS = 64


def frame_warnings(views: ViewSet, scene: CheckedScene) -> tuple[str, ...]:
    """Warn if the scene lies behind the cameras, or out of sight of most: a sample of positions and cameras tells.

    Files of phones often break the rule of their format. Cameras around a scene tell nothing of that, as it lies before some of
    them either way.
    """
    if views.cameras_from == AUTO_CAMERAS:
        return ()
    means = some_positions(scene.source, _SAMPLE_ROWS)
    behind = np.ones(means.shape[1], bool)
    cameras = views.cameras[:: -(-len(views.cameras) // _SAMPLE_VIEWS)]
    blind = 0
    for camera in cameras:
        x, y, z = product(camera.rotation, means) + camera.translation[:, None]
        behind &= z <= 0
        depth = np.maximum(z, 0.0)
        across, down = camera.fx * x + camera.cx * depth, camera.fy * y + camera.cy * depth
        inside = (across > 0) & (across < camera.width * depth) & (down > 0) & (down < camera.height * depth)
        blind += not inside.any()
    share = float(behind.mean())
    if scene.frame != RDF and share > BEHIND_SHARE:
        return (
            f"{100 * share:.0f} % of the Gaussians lie behind all {len(views.cameras)} cameras of {views.cameras_from}. The "
            f"file's axes were read as {scene.frame.name} (x, y, z) and turned into RDF. Give the right ones with --frame, "
            "such as --frame RDF for a file in the cameras' own frame.",
        )
    if 2 * blind > len(cameras):
        return (
            f"{blind} of {len(cameras)} compared cameras of {views.cameras_from} have nothing of the scene in sight: they look "
            "away from it or are far from it. Are the cameras in the scene's frame?",
        )
    return ()


def view_warnings(
    views: ViewSet, scored: Scored | None, count: int, trained: float | None, held_out: float | None
) -> tuple[str, ...]:
    """Warnings of a run, as sentences for a person.

    `views`: all views of the run. `scored`: numbers of scored views and of unseen Gaussians; `None` if the search
    measured no costs. `count`: Gaussians of the scene. `trained`, `held_out`: mean fidelity on training views and on
    held-out views, dB; `None` if not measured.
    """
    found = []
    if trained is not None and held_out is not None and trained - held_out > FIT_GAP:
        found.append(
            f"Fidelity is {trained:.1f} dB on training views and {held_out:.1f} dB on held-out views, {trained - held_out:.1f} "
            "dB less. The result fits the views that were scored, and others may look worse. Give more cameras, and "
            "leave made ones in (--views-margin)."
        )
    if scored is not None and scored.poses < NEEDED_VIEWS:
        found.append(
            f"Only {scored.poses} camera views were used; below about {NEEDED_VIEWS} the result may look worse from elsewhere. "
            "Give more cameras, and leave made ones in (--views-margin)."
        )
    if scored is not None and views.cameras_from == AUTO_CAMERAS and scored.unseen > UNSEEN_SHARE * count:
        found.append(
            f"{scored.unseen} of {count} Gaussians ({100 * scored.unseen / count:.1f} %) appear in none of the {scored.poses} "
            "automatic views that were scored, so nothing checked how they look. Give the scene's cameras (--cameras PATH), or "
            "choose with --unseen what happens to them."
        )
    return tuple(found)
