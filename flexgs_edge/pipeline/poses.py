"""The poses that costs are measured from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from flexgs_edge.best.effort import EFFORTS, sampled_poses
from flexgs_edge.cameras import Camera
from flexgs_edge.cameras.order import farthest_order
from flexgs_edge.pipeline.margin import with_margin
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.render import Renderer
from flexgs_edge.scene.source import SceneSource


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
    """As many poses as the effort scores, farthest first; with `views_margin` as many made ones (see `with_margin`).

    Names often go round a scene in rings: 8 of the sample's 70 poses evenly spread by name lost 7.8 dB where these lose 1.0 at
    the same bytes (docs/performance.md).
    """
    ordered, most = [cameras[i] for i in farthest_order(cameras)], EFFORTS[options.effort].views
    chosen = with_margin(renderer, source, ordered, most) if options.views_margin else ordered[:most]
    given = {id(camera) for camera in cameras}
    return ScoredPoses(sampled_poses(chosen, source.count), sum(id(camera) not in given for camera in chosen))
