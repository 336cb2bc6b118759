"""Chooses the scored poses: the training poses that costs are measured from, and how many pixels of each we look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.order import covering_order
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.methods.best.effort import EFFORTS, LARGEST_STEP, pixels_of, sampled_poses, sampling_steps
from flexgs_edge.methods.best.margin import margin_of
from flexgs_edge.methods.best.needed_poses import needed_poses, poses_beside
from flexgs_edge.methods.best.view_weights import KnownErrors, base_errors, rareness, view_weights
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import DEFAULT_MAX_DROP, CompressOptions
from flexgs_edge.scene.lower_sh import without_degrees
from flexgs_edge.scene.sample import some_positions
from flexgs_edge.scene.source import SceneSource

FINE_DROP, FINE_FIDELITY, FINE_RATIO = 0.3, 42.0, 30.0
"""Targets stricter than these (dB, dB, compression ratio) keep most SH of most Gaussians. Colours then have as many values
as a part of the pixels, and a refit to that part would overfit. So such targets get every pixel of as many poses as the
effort allows: docs/results/tuning.md#fine_drop"""
COVERAGE_POSES = 32
"""Poses that tell how much of the views the scene covers. All 220 of one scene took a tenth of the run."""
BESIDE_FINER = 2.0
"""How much finer than in the mean we look at poses beside a view that lost too much: docs/results/tuning.md#needed"""


@dataclass(frozen=True)
class ScoredPoses:
    """The scored poses, the most important first.

    Parameters
    ----------
    cameras : list of Camera
        At every pixel, or at as many as the scene's Gaussians need.
    made : int
        How many of them were generated (`--views-margin`).
    known : KnownErrors, optional
        What decides how often descents look at a pose. Default: all alike.
    given : tuple of Camera
        The given ones among them, at every pixel.
    step : float
        Mean distance in pixels between the points that we look at.
    """

    cameras: list[Camera]
    made: int = 0
    known: KnownErrors | None = None
    given: tuple[Camera, ...] = ()
    step: float = 1.0

    def beside(self, views: Sequence[Camera], renderer: Renderer, source: SceneSource) -> list[Camera]:
        """Further poses beside views that lost too much, and nearer and farther ones of these.

        Parameters
        ----------
        views : sequence of Camera
            The views.
        renderer : Renderer
            With nothing loaded.
        source : SceneSource
            The original.
        """
        poses = [pose for view in views for pose in poses_beside(view, self.given)]
        poses += margin_of(renderer, source, poses, self.given)
        return sampled_poses(poses, [max(self.step / BESIDE_FINER, 1.0)] * len(poses))


def scored_poses(
    cameras: Sequence[Camera],
    options: CompressOptions,
    renderer: Renderer,
    source: SceneSource,
    covered_decides: bool = False,
    deciding: Sequence[Camera] = (),
    photo: Callable[[int, np.ndarray], np.ndarray] | None = None,
) -> ScoredPoses:
    """Choose as many poses as the effort scores. Each next pose is the one that adds most to what those before it see.

    A few poses chosen like this give costs about as good as all poses do: docs/results/speed.md#scoring-fewer-views

    With `makes_poses`, generated poses come on top: see `margin_of` and `needed_poses`.

    Parameters
    ----------
    cameras : sequence of Camera
        All training poses.
    options : CompressOptions
        Effort, target and `makes_poses`.
    renderer : Renderer
        With nothing loaded.
    source : SceneSource
        The original.
    covered_decides : bool
        As for `Quality`: only pixels that the scene covers count as pixels to look at. Default: all pixels count.
    deciding : sequence of Camera
        The views that decide.
    photo : callable, optional
        The photo of one of these ([H, W, 3] f32) by its place and a render, if photos decide. Poses then get pixels by
        `view_weights`. Default: alike.
    """
    plan = EFFORTS[options.effort]
    positions = some_positions(source)
    order = covering_order(cameras, positions, renderer.near, plan.views)
    rest = sorted(set(range(len(cameras))) - set(order))
    ordered = [cameras[i] for i in (*order, *rest)]
    fine = is_fine(options, source)
    # Without photos, poses are chosen for what they add: all are needed.
    pixels = [camera.width * camera.height for camera in ordered]
    most = plan.views if fine or covered_decides else plan.poses_of(pixels, source.count)
    chosen, given = ordered[:most], {id(camera) for camera in cameras}
    if options.makes_poses:
        scored = [*chosen, *margin_of(renderer, source, chosen, cameras)]
        needed = needed_poses(scored, chosen, ordered[most:], deciding, positions, renderer.near)
        chosen = [*scored, *needed, *margin_of(renderer, source, needed, cameras)]
    drawn, steps = chosen, [1.0]
    errors = None
    if photo is not None:
        drop = options.max_drop or DEFAULT_MAX_DROP
        errors = KnownErrors(
            deciding, base_errors(renderer, source, deciding, photo, options.base_psnr or DEFAULT_BASE_PSNR), drop
        )
    if not fine:
        steps = sampling_steps(chosen, source.count * plan.pixels)
        if errors is not None:
            weights = view_weights(errors.slopes(chosen), rareness(chosen, positions, renderer.near))
            # As many pixels as without weights, which may be more than are needed.
            steps = sampling_steps(chosen, pixels_of(chosen, steps), weights=weights)
        if max(steps) > 1 and covered_decides:
            # A small object in a large view would fall between the pixels.
            steps = sampling_steps(chosen, source.count * plan.pixels, _coverage(renderer, source, chosen))
        drawn = sampled_poses(chosen, steps)
    own = tuple(camera for camera in chosen if id(camera) in given)
    return ScoredPoses(drawn, len(chosen) - len(own), errors, own, sum(steps) / len(steps))


def _coverage(renderer: Renderer, source: SceneSource, cameras: Sequence[Camera]) -> float:
    """Share of the pixels of all views that the scene covers, from every `LARGEST_STEP`-th pixel in both directions.

    Of more than `COVERAGE_POSES` views, it looks at so many at least, evenly spread among them.
    """
    covered, pixels = 0.0, 0
    with renderer.load(without_degrees(source, 0)) as scene:
        apart = max(len(cameras) // COVERAGE_POSES, 1)
        few = [camera.every(LARGEST_STEP) for camera in cameras[::apart]]
        for camera in renderer.in_turn(scene, few):
            renderer.render_planes(scene, camera)
            covered += renderer.drawn_coverage() * camera.width * camera.height
            pixels += camera.width * camera.height
    renderer.release()
    return covered / pixels


def is_fine(options: CompressOptions, source: SceneSource) -> bool:
    """Whether the target allows so little loss that we need every pixel of the scored poses."""
    ply_bytes = source.count * inria_dtype(source.sh_degree).itemsize
    if options.max_size is not None or options.min_ratio is not None:
        ratio = options.min_ratio if options.max_size is None else ply_bytes / options.max_size
        return ratio is not None and ratio < FINE_RATIO
    if options.min_fidelity is not None:
        return options.min_fidelity > FINE_FIDELITY
    return options.max_drop is not None and options.max_drop < FINE_DROP
