"""`--clean`: leave out what clouds views, or lies where nothing else is, and say what that did to the views.

Photos judge each Gaussian by the change of the squared error when it goes (`measure_changes`). What stands in the light of a
floater seems to disturb too, so those that gain most go first, and the rest are measured again. What views hardly see is
judged by how isolated it is.

A pixel is linear in the alpha of one Gaussian, so taking it away takes its light e away: what the target has more than the view,
r, becomes r + e. The squared error changes by e^2 + 2 r e. A descent's gradient has the second part, but for the few
pixels where alpha is capped.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR, FIXED_WEIGHT
from flexgs_edge.io.exchange import wants_double
from flexgs_edge.io.ply import write_ply
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.quality.psnr import exposure_gains, mse_of_psnr, with_gains
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import RemovedGroup
from flexgs_edge.run.options import GENTLE, CompressOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.reporter import Reporter
from flexgs_edge.run.run import Run
from flexgs_edge.scene.check import alive
from flexgs_edge.scene.crop import usual_bounds
from flexgs_edge.scene.isolation import isolation, usual_deviation
from flexgs_edge.scene.source import SceneSource, SelectSource, some_positions
from flexgs_edge.views.sums import view_parts

CHANCE = 8.0
"""A Gaussian contradicts the photos if the views gain so many times what chance gives it, and more than `NOTHING`."""
NOTHING = 1e-4  # This share of the squared error of all views counts as nothing: .0004 dB
TOGETHER = 16  # Of those, the ones go first that gain at least one part in so many of the largest gain
ROUNDS = 8
ISOLATED = 6.0  # Two measures of three standard deviations each
THOROUGH_LOSS = 0.01  # A kind may cost the views that report so much, dB
NEAR, NEEDLE, GIANT = 0.25, 20.0, 0.25
"""Words for what goes: nearer to a camera than this share of what it usually has before it, so many times longer than wide, or
larger than this share of the scene."""
SLOPE = 3  # Plane of sum(r e) in the sums of a gradient
ROW_BYTES = 160  # Bytes a row while neighbours are looked for, or changes added up
KINDS = ("invisible", "near cameras", "needles", "giants", "floaters", "isolated", "unseen and isolated")
INVISIBLE, FLOATERS, LONE, UNSEEN = 0, 4, 5, 6


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


def cleaned(run: Run[CompressOptions], renderer: Renderer) -> Run[CompressOptions]:
    """The same run without what `--clean` finds (stage `clean`); as it is where the option is not given.

    `renderer`: draws; nothing is loaded afterwards.
    """
    if run.options.clean is None:
        return run
    assert run.plan is not None
    source, taken = run.source, ROW_BYTES * run.source.count
    with run.clock.stage("clean"):
        run.budget.take("cleaning", taken)
        judge = QualityEvaluator(renderer, source, run.seen, run.plan.report, base_psnr=run.options.base_psnr)
        try:
            with renderer.load(source) as loaded:
                judge.prepare(loaded, run.progress)
            groups, gone = _verdict(run, renderer, judge, _find(run, renderer, judge.base_psnr))
            if run.reporter is not None and gone.any():
                _show(run, renderer, run.reporter, gone)
        finally:
            renderer.release()
            judge.close()
            run.budget.give(taken)
    notes = tuple(f"--clean {run.options.clean}: {group}" for group in groups or ("nothing to remove",))
    for note in notes:
        LOG.info("%s", note)
    kept, removed = (SelectSource(source, np.flatnonzero(which), notes) for which in (~gone, gone))
    return replace(run.of_source(kept), removed=tuple(groups), removed_rows=removed)


def write_removed(run: Run[CompressOptions]) -> None:
    """Write what a cleaning took away, if `--keep-removed` asks for it and there is something."""
    place, rows = run.options.keep_removed, run.removed_rows
    if place is None or rows is None or run.options.dry_run:
        return
    if rows.count:
        write_ply(place, rows, force=run.options.force, double=wants_double(rows)[0])
    LOG.info(
        "%s: %s", place, f"{rows.count} removed Gaussians" if rows.count else "not written, since nothing was removed"
    )


def _find(run: Run[CompressOptions], renderer: Renderer, base_psnr: float) -> np.ndarray:
    """[N] i8, the place in `KINDS` of each Gaussian that should go; -1 for the others."""
    source, views = run.source, run.seen
    planes = source.read(slice(0, source.count), ["means", "log_scales", "opacity_logits"])
    dead, lone = ~alive(planes["opacity_logits"][0]), isolation(planes["means"], planes["log_scales"]) > ISOLATED
    left, against, changes = _contradicted(run, renderer, np.flatnonzero(~dead))
    pixels = sum(camera.width * camera.height for camera in views.of(views.train or views.held_out))
    error = changes.error or mse_of_psnr(base_psnr) * 3 * pixels
    cost = np.where(lone[left], np.maximum(changes.total, 0.0), np.inf)
    order = np.argsort(cost, kind="stable")
    most = 0.0 if run.options.clean == GENTLE else NOTHING * error
    alone = order[np.cumsum(cost[order]) <= most]
    found = np.full(source.count, -1, np.int8)
    found[dead] = INVISIBLE
    found[left[alone]] = np.where(changes.cost[alone] > 0, LONE, UNSEEN)
    for rows, otherwise in ((against, FLOATERS), (np.flatnonzero(found == LONE), LONE)):
        found[rows] = _kinds(run, rows, otherwise)
    return found


def _contradicted(
    run: Run[CompressOptions], renderer: Renderer, left: np.ndarray
) -> tuple[np.ndarray, np.ndarray, Changes]:
    """Split rows into those that stay and those that photos contradict; and the changes of the former."""
    views, against = run.seen, [left[:0]]
    measured, photos = views.train or views.held_out, views.photos

    def photo(place: int, image: np.ndarray) -> np.ndarray:
        assert photos is not None
        found = photos.load(measured[place])
        return with_gains(found, exposure_gains(image, found) if views.fits_exposure else None, image)

    for number in range(ROUNDS + 1):
        kept, target = SelectSource(run.source, left), None if photos is None else photo
        changes = measure_changes(renderer, kept, views.of(measured), target, run.progress)
        gain = -changes.total
        goes = (gain > CHANCE * changes.chance) & (gain > NOTHING * changes.error)
        if number == ROUNDS or not goes.any():
            break
        goes &= gain >= gain[goes].max() / TOGETHER
        against.append(left[goes])
        left = left[~goes]
    return left, np.sort(np.concatenate(against)), changes


def _kinds(run: Run[CompressOptions], rows: np.ndarray, otherwise: int) -> np.ndarray:
    """[n] i64, the places in `KINDS` that tell most about the looks of some rows."""
    part = run.source.read(rows, ["means", "log_scales"])
    places, scales = part["means"] + run.source.origin[:, None], np.sort(part["log_scales"].astype(np.float64), axis=0)
    usual = some_positions(run.source)
    low, high = usual_bounds(usual)
    near = np.zeros(len(rows), bool)
    for camera in run.seen.cameras:
        center = camera.center[:, None]
        before = float(np.median(np.linalg.norm(usual - center, axis=0)))
        near |= np.linalg.norm(places - center, axis=0) < NEAR * before
    needles = scales[2] - scales[1] > np.log(NEEDLE)
    giants = np.exp(scales[2]) > GIANT * np.linalg.norm(np.subtract(high, low))
    return np.select([near, needles, giants], [1, 2, 3], otherwise)


def _verdict(
    run: Run[CompressOptions], renderer: Renderer, judge: QualityEvaluator, found: np.ndarray
) -> tuple[list[RemovedGroup], np.ndarray]:
    """Each kind that was found, and which rows go ([N] bool): a kind stays if the views that report lose by its removal."""
    gone, groups = found >= 0, []
    allowed = 0.0 if run.options.clean == GENTLE else THOROUGH_LOSS
    now = _loss(run, renderer, judge, gone) if gone.any() else 0.0
    for kind in np.unique(found[gone]).tolist():
        rows = found == kind
        before = now if kind == INVISIBLE else _loss(run, renderer, judge, gone & ~rows)
        gain = before - now
        centre = np.median(run.source.read(np.flatnonzero(rows), ["means"])["means"], axis=1) + run.source.origin
        x, y, z = centre.tolist()
        stays = gain < -allowed
        groups.append(RemovedGroup(KINDS[kind], int(np.count_nonzero(rows)), (x, y, z), gain, not stays))
        if stays:
            gone, now = gone & ~rows, before
    return groups, gone


def _show(run: Run[CompressOptions], renderer: Renderer, reporter: Reporter, gone: np.ndarray) -> None:
    """Show a report the view that shows most of what goes ([N] bool): before, after, and that alone."""
    assert run.plan is not None
    source, cameras = run.source, run.seen.of(run.plan.report)
    kept, removed = (SelectSource(source, np.flatnonzero(which)) for which in (~gone, gone))
    with renderer.load(removed) as scene:
        shown = [float(renderer.shown_weights(scene, camera)[1].sum()) for camera in cameras]
    camera, images = cameras[int(np.argmax(shown))], []
    for part in (source, kept, removed):
        with renderer.load(part) as scene:
            images.append(renderer.render(scene, camera).copy())
    reporter.show_cleaned(camera, *images)


def _loss(run: Run[CompressOptions], renderer: Renderer, judge: QualityEvaluator, gone: np.ndarray) -> float:
    """What the views that report lose without some rows, dB."""
    with renderer.load(SelectSource(run.source, np.flatnonzero(~gone))) as scene:
        quality = judge.compare(scene, progress=run.progress)
    return quality.covered_modelled_drop if quality.drop is None else quality.drop


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
