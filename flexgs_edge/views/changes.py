"""What views lose or gain when one Gaussian is taken away: the exact change of the squared error against their targets.

A pixel is linear in the alpha of one Gaussian, so taking it away takes its light e away: what the target has more than the view,
r, becomes r + e. The squared error changes by e^2 + 2 r e. A descent's gradient has the second part, but for the few
pixels where alpha is capped.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR, FIXED_WEIGHT
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.isolation import usual_deviation
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.sums import view_parts

SLOPE = 3  # Plane of sum(r e) in the sums of a gradient


@dataclass(frozen=True)
class Changes:
    """Sums over pixels, three channels and views."""

    # [N] f64, sum(e^2): what removal would cost if the targets were the views; 0 for rows that no view sees.
    cost: np.ndarray
    slope: np.ndarray  # [N] f64, sum(r e): below 0 where the targets lack this light
    error: float  # squared error of the views against their targets

    @property
    def total(self) -> np.ndarray:
        """[N] f64, change of the squared error when this row alone goes: a gain below 0."""
        total: np.ndarray = self.cost + 2 * self.slope
        return total

    @property
    def chance(self) -> np.ndarray:
        """[N] f64, the gain that chance gives: what targets and views differ by is noise for most rows."""
        light = np.sqrt(self.cost)
        seen = light > 0
        chance: np.ndarray = 2 * usual_deviation(self.slope[seen] / light[seen]) * light
        return chance


def measure_changes(
    renderer: Renderer,
    source: SceneSource,
    cameras: Sequence[Camera],
    target: Callable[[int, np.ndarray], np.ndarray] | None = None,
    progress: Progress = SILENT,
) -> Changes:
    """Measure changes in one pass over some views.

    `target`: gives the target of a view, [H, W, 3] f32, from its place among the cameras and its render, clamped. Default: the
    render itself. Nothing is loaded afterwards.
    """
    cost, slope, error = np.zeros(source.count), np.zeros(source.count), 0.0
    with renderer.load(source, references=True) as scene:
        views = progress.track(renderer.in_turn(scene, cameras), "measuring what to clean", len(cameras))
        for place, camera in enumerate(views):
            for rows, sums in view_parts(renderer, scene, renderer.removal_sums(scene, camera)):
                cost[rows] += sums[:, 0] / FIXED_ERROR
            if target is None:
                continue
            planes = renderer.drawn_planes()
            within = np.s_[:, : camera.height, : camera.width]
            image = planes[within].clip(0.0, 1.0).transpose(1, 2, 0)
            wanted = target(place, image)
            error += float(np.square(wanted - image).sum(dtype=np.float64))
            half = np.zeros(planes.shape, np.float16)
            half[within] = wanted.transpose(2, 0, 1)
            for rows, sums in view_parts(renderer, scene, renderer.gradient_sums(scene, camera, half)):
                slope[rows] += sums[:, SLOPE] / FIXED_WEIGHT
    renderer.release()
    return Changes(cost, slope, error)
