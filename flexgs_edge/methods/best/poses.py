"""Chooses the scored poses: the training poses that costs are measured from, and how many pixels of each we look at."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import FARTHER, NEARER, at_distance, between
from flexgs_edge.cameras.order import GAIN_DIGITS, SAME_VIEW, covering_order, in_picture, nearest, squared_distances
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.methods.best.effort import EFFORTS, LARGEST_STEP, pixels_of, sampled_poses, sampling_steps
from flexgs_edge.quality.psnr import contrast, far_bases, mse, mse_of_psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.few_poses import visible_depths
from flexgs_edge.run.options import DEFAULT_MAX_DROP, CompressOptions
from flexgs_edge.scene.source import SceneSource, some_positions, without_degrees

TURN = (NEARER, None, FARTHER, None, NEARER, None, FARTHER, 0.0)
"""What each of eight given poses gets: a pose at so many times the distance, or (0) one half way to its nearest neighbour:
docs/results/tuning.md#margin. They come on top of the given poses; in place of them they would make files larger."""
LEAST_GAIN = 0.2
"""A pose is needed if it adds at least this share of its own picture to what the scored ones see:
docs/results/tuning.md#needed"""
BESIDE = 4  # So many given poses nearest to a view that lost too much make poses half way to it
MOST_TIMES = 2  # Needed poses are at most so many times the given ones that are scored
POINTS = 512  # Most points that tell what poses see
FINE = {"max_drop": 0.3, "min_fidelity": 42.0, "min_ratio": 30.0}
"""Targets stricter than these keep most SH of most Gaussians. Colours then have as many values
as a part of the pixels, and a refit to that part would overfit. So such targets get every pixel of as many poses as the
effort allows: docs/results/tuning.md#fine_drop"""


@dataclass(frozen=True)
class KnownErrors:
    """How near the original is to the photos of the views that decide."""

    cameras: Sequence[Camera]  # the m views
    errors: np.ndarray  # [m] f64, from `base_errors`
    drop: float  # allowed drop, dB

    def slopes(self, cameras: Sequence[Camera]) -> np.ndarray:
        """[n] f64, above 0 to 1: the slope of the drop by the error, of the view that is nearest to each camera.

        `cameras`: the n poses.
        """
        allowed = float(np.median(self.errors)) * (10 ** (self.drop / 10) - 1)
        slopes = 1.0 / (self.errors + max(allowed, 1e-12))
        nearest = squared_distances(cameras, self.cameras).argmin(axis=1)
        relative: np.ndarray = (slopes / slopes.max())[nearest]
        return relative


def base_errors(
    renderer: Renderer,  # with nothing loaded
    source: SceneSource,  # the original
    cameras: Sequence[Camera],  # the views that decide
    photo: Callable[[int, np.ndarray], np.ndarray],
    base_psnr: float = DEFAULT_BASE_PSNR,  # as for `far_bases`
    step: int = 4,  # every fourth pixel in both directions is compared
) -> np.ndarray:
    """[n] f64, mean squared error of the original against the photo of each view, or that of `far_bases`.

    `photo`: the photo of a view, [H, W, 3] f32 in [0, 1], by its place in `cameras` and a render of this size.
    """
    errors, contrasts = [], []
    with renderer.load(source) as scene:
        coarse = [camera.every(step) for camera in cameras]
        for place, camera in enumerate(renderer.in_turn(scene, coarse)):
            image = np.clip(renderer.render(scene, camera), 0.0, 1.0)
            seen = photo(place, image)
            errors.append(mse(image, seen))
            contrasts.append(contrast(seen))
    renderer.release()
    bases = far_bases(errors, contrasts, base_psnr)
    return np.array([error if base is None else mse_of_psnr(base) for error, base in zip(errors, bases, strict=True)])


def view_weights(slopes: np.ndarray, power: float = 4.8, least: float = 1e-6) -> np.ndarray:
    """[n] f64, `least` to 1: how much an error counts in each scored pose, from `KnownErrors.slopes`.

    The slope alone would minimise the mean drop. A higher `power` of it lifts the worst view, as a soft maximum does:
    docs/results/tuning.md#view_weights
    """
    weights: np.ndarray = slopes**power
    relative: np.ndarray = np.maximum(weights / weights.max(), least)
    return relative


def margin_of(
    renderer: Renderer, source: SceneSource, poses: Sequence[Camera], cameras: Sequence[Camera]
) -> list[Camera]:
    """Five made poses for every eight.

    `renderer`: with nothing loaded. `poses`: those that are scored, the most important first. `cameras`: all training poses.
    """
    turns = [(camera, TURN[place % len(TURN)]) for place, camera in enumerate(poses)]
    depths = iter(visible_depths(renderer, source, [camera for camera, times in turns if times]))
    made = []
    for camera, times in turns:
        if times:
            made.append(at_distance(camera, next(depths), times))
        elif times == 0.0 and len(cameras) > 1:
            others = [other for other in cameras if other is not camera]
            away = [float(np.square(other.center - camera.center).sum()) for other in others]
            made.append(between(camera, others[int(np.argmin(away))]))
    return made


def needed_poses(
    scored: Sequence[Camera],  # poses that are scored already, given and made ones
    given: Sequence[Camera],  # the given ones among them
    rest: Sequence[Camera],  # Given poses that are not scored. They may be needed as they are.
    deciding: Sequence[Camera],
    points: np.ndarray,  # [3, n] f64, a sample of the scene's positions, world coordinates
    near: float,  # near plane, scene units
) -> list[Camera]:
    """The poses that add enough to what the scored ones see, each next one the one that adds most.

    A point adds 1 / (1 + k) to a pose that has it in its picture. Each other pose that shows the point adds to k, as in
    `covering_order`, and less if it shows the point smaller: by the square of the ratio of its sizes in both pictures.
    What a pose adds is the mean over the points in its picture. Occlusion is ignored.

    `deciding`: the views that decide. They are not scored, but poses half way to them are, if they are needed.
    """
    if not scored:
        return []
    points = points[:, :: -(-points.shape[1] // POINTS)] if points.shape[1] else points
    there = _Seen.by([_seen(camera, points, near) for camera in scored])
    found = list(rest)
    found += [between(camera, other) for camera, other in _pairs(given, deciding, there, points, near)]
    known = [_known(_seen(camera, points, near), there) for camera in found]
    bounds = np.array([_gain(_seen(camera, points, near), sums) for camera, sums in zip(found, known, strict=True)])
    added: list[_Seen] = []
    upto = [0] * len(found)
    needed: list[Camera] = []
    # What a pose adds only falls, so what it added before is an upper bound.
    while found and len(needed) < MOST_TIMES * len(given):
        best = int(np.argmax(bounds))
        if bounds[best] < LEAST_GAIN:
            break
        seen = _seen(found[best], points, near)
        if upto[best] == len(added):
            needed.append(found[best])
            added.append(_Seen.by([seen]))
            bounds[best] = -1.0
            continue
        for other in added[upto[best] :]:
            known[best] += _known(seen, other)
        upto[best], bounds[best] = len(added), _gain(seen, known[best])
    return needed


def poses_beside(view: Camera, given: Sequence[Camera]) -> list[Camera]:
    """Poses half way between a view and the given poses nearest to it.

    `view`: a view that lost too much. `given`: the given poses that are scored.
    """
    return [between(given[place], view) for place in nearest(view, given, BESIDE)]


@dataclass(frozen=True)
class _Seen:
    """Which points a pose shows ([n] bool), their directions ([3, n] f64), and their distances in focal lengths ([n] f64).

    Of several poses, each array has one row a pose.
    """

    shown: np.ndarray
    ahead: np.ndarray
    away: np.ndarray

    @staticmethod
    def by(poses: Sequence[_Seen]) -> _Seen:
        return _Seen(*(np.stack([getattr(pose, name) for pose in poses]) for name in ("shown", "ahead", "away")))

    def without(self, place: int) -> _Seen:
        return _Seen(*(np.delete(values, place, axis=0) for values in (self.shown, self.ahead, self.away)))


def _seen(camera: Camera, points: np.ndarray, near: float) -> _Seen:
    ahead = points - camera.center[:, None]
    away = np.maximum(np.sqrt(np.square(ahead).sum(axis=0)), np.finfo(np.float64).tiny)
    return _Seen(in_picture(camera, points, near), ahead / away, away / camera.fx)


def _known(seen: _Seen, others: _Seen) -> np.ndarray:
    """[n] f64, how often other poses show each point from about the same direction."""
    alike = np.maximum(1.0 - (1.0 - (seen.ahead * others.ahead).sum(axis=1)) / SAME_VIEW, 0.0)
    found: np.ndarray = (others.shown * alike * np.square(np.minimum(seen.away / others.away, 1.0))).sum(axis=0)
    return found


def _gain(seen: _Seen, known: np.ndarray) -> float:
    gain = np.where(seen.shown, 1.0 / (1.0 + known), 0.0).sum() / max(np.count_nonzero(seen.shown), 1)
    return round(float(gain), GAIN_DIGITS)


def _pairs(
    given: Sequence[Camera], deciding: Sequence[Camera], there: _Seen, points: np.ndarray, near: float
) -> list[tuple[Camera, Camera]]:
    """The nearest six of each given pose that would itself add enough: all others have enough poses round them.

    Views that decide and would add enough are paired with the given poses nearest to them.
    """
    pairs: dict[tuple[int, int], None] = {}
    for place, camera in enumerate(given):
        own = _Seen(there.shown[place], there.ahead[place], there.away[place])
        if _gain(own, _known(own, there.without(place))) >= LEAST_GAIN:
            for other in nearest(camera, given, 6):
                pairs[min(place, other), max(place, other)] = None
    found = [(given[first], given[second]) for first, second in pairs]
    scored = {id(camera) for camera in given}
    for view in deciding:
        if id(view) in scored:
            continue
        own = _seen(view, points, near)
        if _gain(own, _known(own, there)) >= LEAST_GAIN:
            found += [(given[place], view) for place in nearest(view, given, BESIDE)]
    return found


@dataclass(frozen=True)
class ScoredPoses:
    """The scored poses, the most important first."""

    cameras: list[Camera]  # at every pixel, or at as many as the scene's Gaussians need
    made: int = 0  # how many of them were generated (`--views-margin`)
    known: KnownErrors | None = None  # What decides how often descents look at a pose. Default: all alike.
    given: tuple[Camera, ...] = ()  # the given ones among them, at every pixel
    step: float = 1.0  # mean distance in pixels between the points that we look at

    def beside(self, views: Sequence[Camera], renderer: Renderer, source: SceneSource) -> list[Camera]:
        """Further poses beside views that lost too much, and nearer and farther ones of these.

        We look at them twice as finely as at others in the mean: docs/results/tuning.md#needed

        `renderer`: with nothing loaded. `source`: the original.
        """
        poses = [pose for view in views for pose in poses_beside(view, self.given)]
        poses += margin_of(renderer, source, poses, self.given)
        return sampled_poses(poses, [max(self.step / 2, 1.0)] * len(poses))


def scored_poses(
    cameras: Sequence[Camera],  # all training poses
    options: CompressOptions,  # effort, target and `makes_poses`
    renderer: Renderer,  # with nothing loaded
    source: SceneSource,  # the original
    covered_decides: bool = False,
    deciding: Sequence[Camera] = (),  # the views that decide
    photo: Callable[[int, np.ndarray], np.ndarray] | None = None,
) -> ScoredPoses:
    """Choose as many poses as the effort scores. Each next pose is the one that adds most to what those before it see.

    A few poses chosen like this give costs about as good as all poses do.

    With `makes_poses`, generated poses come on top: see `margin_of` and `needed_poses`.

    `covered_decides`: as for `Quality`: only pixels that the scene covers count as pixels to look at. Default: all
    pixels count. `photo`: the photo of one of these ([H, W, 3] f32) by its place and a render, if photos decide. Poses
    then get pixels by `view_weights`. Default: alike.
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
            weights = view_weights(errors.slopes(chosen))
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

    Of more than 32 views, it looks at so many at least, evenly spread among them: all 220 of one scene took a tenth of the run.
    """
    covered, pixels = 0.0, 0
    with renderer.load(without_degrees(source, 0)) as scene:
        apart = max(len(cameras) // 32, 1)
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
        return ratio is not None and ratio < FINE["min_ratio"]
    if options.min_fidelity is not None:
        return options.min_fidelity > FINE["min_fidelity"]
    return options.max_drop is not None and options.max_drop < FINE["max_drop"]
