"""`--method best`, the default: rate-distortion optimization with measured costs.

`compress` chooses poses and storage, prunes in rounds, searches for the best candidate, writes it and measures it. The
search asks for exact sizes (`GridCoder`) and measured quality (`QualityEvaluator`).
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import poses_between
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.errors import TargetError
from flexgs_edge.files import temporary_name
from flexgs_edge.goals.steps import Choice, Scored, SearchResult, Step, step_words
from flexgs_edge.goals.target import Measurement
from flexgs_edge.grid.grid_scene import GridScene, values_of
from flexgs_edge.methods.best.allocation import Measure
from flexgs_edge.methods.best.checkpoint import Checkpoint, open_checkpoint
from flexgs_edge.methods.best.effort import effort_of
from flexgs_edge.methods.best.grid_coder import GridCoder, projected_size, with_preview
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.layers import assign_layers, can_sort
from flexgs_edge.methods.best.memory_plan import MemoryPlan, choose_storage
from flexgs_edge.methods.best.memory_plan import expected_bytes as expected_bytes
from flexgs_edge.methods.best.poses import ScoredPoses, scored_poses
from flexgs_edge.methods.best.preview import default_bytes, make_preview
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.search import Candidate, Maker, Product, search, search_size
from flexgs_edge.progress import LOG
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.decoding import decoded
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.few_poses import usual_depth
from flexgs_edge.run.method_result import MethodResult, make_settings, settings_room
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator, measurement_of
from flexgs_edge.run.run import Run, check_smaller
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.units import format_size
from flexgs_edge.views.references import Original, References

See = Callable[[Sequence[int], int], bool]
MakerOf = Callable[[PruneRounds, Measure, See | None], Maker[Product]]
"""Makes the maker of a search from rounds, a measure, and what scores poses beside views that lose too much."""


def compress(run: Run[CompressOptions], renderer: Renderer | None) -> MethodResult:
    """Compress a scene into a `.fgs` of version 2.

    `run`: planned, with views and a target. `renderer`: draws the views. It gets the storage that the search needs. Raises
    `TargetError` when nothing holds and `best_effort` is not set. Raises `BudgetError` when the scene does not fit.
    """
    assert renderer is not None  # the plan has refused runs without views
    output = run.output.path
    with Evaluators(run, renderer) as judges:
        poses = choose_poses(run, renderer, judges.decide)
        folder = Path(run.options.scratch or (tempfile.gettempdir() if output is None else output.parent))
        storage = renderer.storage = choose_storage(run, renderer, poses.cameras, folder)
        judges.prepare()
        kept = None
        if run.options.resume:
            with run.clock.stage("fingerprint"):
                kept = open_checkpoint(run, renderer, poses.cameras, folder)
        LOG.info("searching for %s", run.target.describe())
        coder = GridCoder(renderer, settings_room(run))
        maker = grid_maker(run, coder)
        grid, search = search_best(maker, run, renderer, poses, judges.decide, checkpoint=kept)
        judges.decided()
        if run.options.layers is not None and run.options.layers > 1:
            with run.clock.stage("layers"):
                bits = coder.bits(grid)
                grid = assign_layers(grid, run.options.layers, bits, renderer, poses.cameras, run.progress)
        settings = make_settings(run, search)
        preview = _preview(run, coder, renderer, poses.cameras, grid, settings)
        if output is None:
            size, quality = _tried(run, coder, grid, settings, preview, judges)
        else:
            with temporary_name(output, run.options.force, None if kept is None else kept.key) as place:
                with run.clock.stage("write"):
                    size = coder.write(place, grid, settings, preview)
                check_smaller(size, run.scene.file_bytes, run.options)
                limit = run.target.limit_bytes
                if search.reached and limit is not None and size > limit:
                    raise TargetError(
                        f"{run.target.describe()}: with its layers and its preview the file has {size} bytes; "
                        "ask for fewer layers (--layers) or a smaller preview (--preview)"
                    )
                quality = judges.measure(decoded(open_fgs(place), renderer))
            LOG.info("wrote %s, %s", output, format_size(size))
        if kept is not None:
            kept.remove()
        storage.close()
        return MethodResult(
            size=size,
            count=grid.count,
            sh_count=grid.sh_count,
            sh_degree=grid.sh_degree,
            choice=search.chosen.choice,
            search=search,
            quality=quality,
            trained=judges.trained,
            lost=judges.lost,
            step_sizes=grid.step_sizes,
            preview_bytes=len(preview),
        )


def _preview(
    run: Run[CompressOptions],
    coder: GridCoder,
    renderer: Renderer,
    cameras: Sequence[Camera],
    grid: GridScene,
    settings: dict[str, Any],
) -> bytes:
    """The preview that was asked for, or the one that a large file has by default."""
    most, limit, size = run.options.preview, run.target.limit_bytes, coder.size(grid, settings)
    if most is None:
        most = default_bytes(size) if can_sort(grid.count, run.source.count) else 0
        if limit is not None and size + with_preview(most) > limit:
            return b""
    if not most:
        return b""
    with run.clock.stage("preview"):
        preview = make_preview(grid, most, coder.bits(grid), renderer, cameras, settings, run.progress)
    if preview:
        LOG.info("a preview of %s comes first", format_size(len(preview)))
    else:
        LOG.warning("no preview fits into %s: the file has none", format_size(most))
    return preview


def _tried(
    run: Run[CompressOptions],
    coder: GridCoder,
    grid: GridScene,
    settings: dict[str, Any],
    preview: bytes,
    judges: Evaluators,
) -> tuple[int, Quality]:
    """Bytes and quality of the file in a dry run. A report reads the contents from a file that is removed afterwards."""
    if run.reporter is not None:
        run.reporter.read_contents_of(lambda place: coder.write(place, grid, settings, preview))
    size = coder.size(grid, settings, preview)
    return size, judges.measure(MemorySource(values_of(grid, judges.storage), origin=grid.origin))


def grid_maker(run: Run[CompressOptions], coder: GridCoder) -> MakerOf[GridScene]:
    """Make makers of the grid of a `.fgs`."""

    def size_of(grid: GridScene) -> int:
        return projected_size(run.options, coder.size(grid))

    plan = effort_of(run)

    def make(rounds: PruneRounds, measure: Measure, see: See | None = None) -> GridMaker:
        maker = GridMaker(rounds, size_of, measure, plan, run.options.refit, rounds.original.steps, see)
        maker.selection.most = run.options.max_gaussians
        return maker

    return make


def choose_poses(run: Run[CompressOptions], renderer: Renderer, judge: QualityEvaluator) -> ScoredPoses:
    """`scored_poses` for a run.

    `run`: planned. `renderer`: with nothing loaded. `judge`: on the views that decide.
    """
    return scored_poses(
        run.seen.of(run.seen.train),
        run.options,
        renderer,
        run.source,
        judge.covered_decides,
        judge.cameras,
        judge.photos_that_decide(run.target),
    )


def search_best(
    make: MakerOf[Product],  # `grid_maker`, or what makes a file of another format
    run: Run[CompressOptions],  # Planned. The storage of `renderer` holds its scene as a whole.
    renderer: Renderer,  # draws the views
    poses: ScoredPoses,  # from `scored_poses`
    judge: QualityEvaluator,  # prepared on the views that decide
    checkpoint: Checkpoint | None = None,  # keeps the rounds for a later run (`--resume`)
) -> tuple[Product, SearchResult]:
    """Search, and return the product to write and all candidates that led to it.

    Raises `TargetError` when nothing holds and `best_effort` is not set. Raises `BudgetError` when the scene does not fit.
    """
    source, options, target = run.source, run.options, run.target
    plan = MemoryPlan.of(run, renderer, poses.cameras)
    depth = usual_depth(renderer, source, poses.cameras) if plan.steps else 1.0
    run.budget.require("a search by measured costs", plan.held + plan.least)
    run.budget.take("the scene and its search", plan.held)
    further = 0
    rounds: PruneRounds | None = None

    def measure(planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        with renderer.load(MemorySource(planes, origin=source.origin)) as kept_scene:
            quality = judge.estimate(kept_scene) if estimate else judge.compare(kept_scene, with_ssim=True)
            return measurement_of(quality)

    def see(views: Sequence[int], number: int) -> bool:
        nonlocal further
        assert rounds is not None
        beside = poses.beside([judge.cameras[view] for view in views], renderer, source)
        seen = rounds.see(beside, number, poses.known)
        if seen:
            further += len(beside)
            LOG.info("views that lose too much: %d; %d poses beside them are scored too", len(views), len(beside))
        return seen

    try:
        with References(renderer.storage.folder) as references, run.clock.stage("search"):
            between = poses_between(poses.cameras) if plan.steps else ()
            turns = poses.known.slopes([*poses.cameras, *between]) if poses.known and plan.steps else None
            original = Original(
                renderer, source.origin, poses.cameras, references, between, run.progress, plan.steps, turns, depth
            )

            def begin(original: Original, checkpoint: Checkpoint | None, see: See | None) -> Maker[Product]:
                nonlocal rounds
                rounds = None  # one at a time: they take most of the memory
                rounds = PruneRounds(original, source, options.refit, options.unseen_share, checkpoint)
                return make(rounds, measure, see)

            def tell(step: Candidate) -> None:
                LOG.info("%s", step_words(as_step(step, source.count), target))

            plain = partial(begin, replace(original, steps=0), None, None)
            fine = partial(begin, original, checkpoint, see if options.makes_poses else None)
            if target.limit_bytes is not None and plan.steps:
                found = search_size(plain, fine, target, options.takes_closest, tell)
            else:
                found = search(fine(), target, best_effort=options.takes_closest, on_step=tell)
            assert rounds is not None
            unseen = rounds.unseen
    finally:
        run.budget.give(plan.held)
    if found.chosen.left_out:
        LOG.warning(
            "%d Gaussians that no scored pose sees were left out: they lie so far away, or are so extreme, that all others "
            "would have to be coded more coarsely",
            found.chosen.left_out,
        )
    steps = tuple(as_step(step, source.count) for step in found.steps)
    scored = Scored(len(poses.cameras) + further, poses.made + further, unseen)
    return found.product, SearchResult(steps[found.steps.index(found.chosen)], found.reached, steps, scored)


def as_step(step: Candidate, count: int) -> Step:
    """The candidate as a step in a record of any method: rates are thousandths of the scene's `count` rows."""
    prune = round(1000 * (1 - step.count / count))
    return Step(
        choice=Choice(prune, min(round(1000 * (step.count - step.sh_count) / count), 1000 - prune)),
        size=step.size,
        measurement=step.measurement,
        excess=step.excess,
        phase="multiplier",
        seconds=step.seconds,
    )
