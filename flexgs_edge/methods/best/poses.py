"""The poses that costs are measured from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.order import covering_order
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.methods.best.effort import EFFORTS, sampled_poses
from flexgs_edge.methods.best.margin import with_margin
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.source import SceneSource

FINE_DROP, FINE_FIDELITY, FINE_RATIO = 0.3, 42.0, 30.0
"""Targets beyond these (dB, dB, times) keep most SH of most Gaussians. These are as many values as a part of the pixels
has, so colours refitted to a part would fit nothing else. Such targets get all pixels of as many poses as the effort
takes: docs/results/tuning.md#fine_drop"""
SAMPLE_ROWS = 4096
"""Gaussians whose positions tell which poses see what."""


@dataclass(frozen=True)
class ScoredPoses:
    """Poses, the most important first.

    Parameters
    ----------
    cameras : list of Camera
        With no more pixels than the scene's Gaussians need.
    made : int
        How many of them nobody took (`--views-margin`).
    """

    cameras: list[Camera]
    made: int = 0


def scored_poses(
    cameras: Sequence[Camera], options: CompressOptions, renderer: Renderer, source: SceneSource
) -> ScoredPoses:
    """As many poses as the effort scores, each next one with the most to add to what those before it see.

    With `views_margin` made ones come on top (see `with_margin`). A few such poses give costs that are about as good as
    those from all poses: docs/results/speed.md#scoring-fewer-views
    """
    plan = EFFORTS[options.effort]
    order = covering_order(cameras, some_positions(source), renderer.near, plan.views)
    rest = sorted(set(range(len(cameras))) - set(order))
    ordered = [cameras[i] for i in (*order, *rest)]
    fine = is_fine(options, source)
    most = plan.views if fine else plan.poses_of([camera.width * camera.height for camera in ordered], source.count)
    chosen = with_margin(renderer, source, ordered, most) if options.views_margin else ordered[:most]
    given = {id(camera) for camera in cameras}
    drawn = chosen if fine else sampled_poses(chosen, source.count * plan.pixels)
    return ScoredPoses(drawn, sum(id(camera) not in given for camera in chosen))


def some_positions(source: SceneSource) -> np.ndarray:
    """[3, n] f64, world: positions of `SAMPLE_ROWS` rows at most, evenly spread."""
    rows = np.arange(0, source.count, max(-(-source.count // SAMPLE_ROWS), 1))
    positions: np.ndarray = source.read(rows, ["means"])["means"].astype(np.float64) + source.origin[:, None]
    return positions


def is_fine(options: CompressOptions, source: SceneSource) -> bool:
    """Whether the target asks for so little loss that every pixel of the scored poses is needed."""
    ply_bytes = source.count * inria_dtype(source.sh_degree).itemsize
    if options.max_size is not None or options.min_ratio is not None:
        ratio = options.min_ratio if options.max_size is None else ply_bytes / options.max_size
        return ratio is not None and ratio < FINE_RATIO
    if options.min_fidelity is not None:
        return options.min_fidelity > FINE_FIDELITY
    return options.max_drop is not None and options.max_drop < FINE_DROP
