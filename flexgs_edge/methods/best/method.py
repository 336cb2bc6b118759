"""`--method best`: measured costs along a path of prune and rescore, one multiplier, grids of equal slope, the real coder."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.cameras.made import poses_between
from flexgs_edge.constants import ALPHA_MIN
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.steps import Scored, SearchResult, Step
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.candidates import Candidate, Product, RateResult
from flexgs_edge.methods.best.checkpoint import Checkpoint
from flexgs_edge.methods.best.effort import EFFORTS, distil_steps
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.best.keep import LAYERS_COST
from flexgs_edge.methods.best.layers import assign_layers
from flexgs_edge.methods.best.multiplier import Measure, MultiplierSearch
from flexgs_edge.methods.best.poses import ScoredPoses
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.spill import SPILLED_ROW_BYTES, least_spilled, needed_bytes
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.judge import Judge, measurement_of
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.source import MemorySource, SceneSource, read_all
from flexgs_edge.views.references import References

LOG = logging.getLogger("flexgs_edge")
Report = Callable[[Candidate], None]
SearchMaker = Callable[[PruneRounds, Measure, Report], MultiplierSearch[Product]]


def grid_search(
    options: CompressOptions, coder: GridCoder, search: type[GridSearch] = GridSearch
) -> SearchMaker[GridScene]:
    """Searches for the grid of a `.fgs`."""

    def size_of(grid: GridScene) -> int:
        size = coder.size(grid)
        return size if options.layers == 1 else round(LAYERS_COST * size)

    plan = EFFORTS[options.effort]

    def make(path: PruneRounds, measure: Measure, report: Report) -> MultiplierSearch[GridScene]:
        steps = distil_steps(options, len(path.cameras))
        return search(path, size_of, measure, plan, options.refit, report, steps)

    return make


def search_best(
    make: SearchMaker[Product],
    renderer: Renderer,
    source: SceneSource,
    poses: ScoredPoses,
    judge: Judge,
    target: Target,
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    on_step: Callable[[Step], None] | None = None,
    progress: Progress = SILENT,
    checkpoint: Checkpoint | None = None,
) -> tuple[Product, SearchResult]:
    """What to write, and the steps that led to it.

    Parameters
    ----------
    make : callable
        `grid_search` or `file_search`.
    source : SceneSource
        A checked scene; held in `renderer.storage` as a whole.
    poses : ScoredPoses
        From `scored_poses`.
    judge : Judge
        Prepared on the views that decide.

    Raises
    ------
    TargetError
        When nothing holds and `best_effort` is not set.
    BudgetError
        When the scene does not fit.
    """
    path_of = open_rounds(renderer, source, poses.cameras, options, budget, clock, progress, checkpoint=checkpoint)
    with path_of as path, clock.stage("search"):
        product, search = search_rounds(make, path, renderer, source, judge, target, options, on_step)
        return product, replace(search, scored=Scored(len(poses.cameras), poses.made, path.unseen))


@contextmanager
def open_rounds(
    renderer: Renderer,
    source: SceneSource,
    scored: Sequence[Camera],
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    progress: Progress = SILENT,
    make: Callable[..., PruneRounds] = PruneRounds,
    checkpoint: Checkpoint | None = None,
) -> Iterator[PruneRounds]:
    """The path that searches walk, at its start; several targets may share it, the weakest compression first.

    Parameters
    ----------
    scored : sequence of Camera
        From `scored_poses`.
    make : callable, optional
        Builds the path from the arguments of `PruneRounds`.
    checkpoint : Checkpoint, optional
        Where the path keeps its rounds.
    """
    storage, steps = renderer.storage, distil_steps(options, len(scored))
    if storage.spills:
        size, least = SPILLED_ROW_BYTES * source.count, least_spilled(renderer, source, largest_of(scored))
    else:
        size, least = needed_bytes(renderer, source, scored, options)
    budget.require("a search by measured costs", size + least)
    budget.take("the scene and its path", size)
    try:
        planes = read_all(source, storage)
        with References(storage.folder) as targets:
            with clock.stage("search"):
                rows = np.flatnonzero(alive(planes["opacity_logits"][0]))
                # Neighbours in space become neighbours in memory: a view of fox takes a seventh less.
                rows = storage.take(rows, near_rows(storage.take(planes["means"], rows), storage))
                path = make(
                    renderer,
                    planes,
                    rows,
                    source.origin,
                    scored,
                    targets,
                    refit=options.refit,
                    unseen=options.unseen_share,
                    progress=progress,
                    between=poses_between(scored) if steps else (),
                    **({} if checkpoint is None else {"checkpoint": checkpoint}),
                )
            del planes  # the path has its own
            yield path
    finally:
        budget.give(size)


def search_rounds(
    make: SearchMaker[Product],
    path: PruneRounds,
    renderer: Renderer,
    source: SceneSource,
    judge: Judge,
    target: Target,
    options: CompressOptions,
    on_step: Callable[[Step], None] | None = None,
) -> tuple[Product, SearchResult]:
    """`search_best` along a path that is there."""

    def measure(planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        with renderer.load(MemorySource(planes, origin=source.origin)) as kept_scene:
            quality = judge.estimate(kept_scene) if estimate else judge.compare(kept_scene, with_ssim=judge.reports)
            return measurement_of(quality)

    def report(step: Candidate) -> None:
        if on_step:
            on_step(as_step(step, source.count))

    search = make(path, measure, report)
    found = search.run(target, options.best_effort)
    if isinstance(found.product, GridScene):
        beyond = len(search.kept(found.chosen.multiplier).rows) - found.product.count
        if beyond:
            LOG.warning(
                "%d Gaussians that no scored pose sees were left out: they lie so far away, or are so extreme, that all others "
                "would have to be coded more coarsely",
                beyond,
            )
    return found.product, _as_search(found, source.count)


def layered(
    grid: GridScene,
    renderer: Renderer,
    poses: ScoredPoses,
    options: CompressOptions,
    progress: Progress = SILENT,
) -> GridScene:
    """The grid in as many layers as asked for."""
    return assign_layers(
        grid,
        options.layers,
        GridCoder(renderer).bits(grid),
        renderer,
        poses.cameras,
        progress,
    )


def alive(logits: np.ndarray) -> np.ndarray:
    """[n] bool: opacity reaches 1/255 (the renderer culls the rest everywhere, so they go first and cost nothing)."""
    return logits >= np.float32(-np.log(1 / ALPHA_MIN - 1) - 1e-3)


def as_step(step: Candidate, count: int) -> Step:
    """The step as every search records it: rates are shares of the scene's rows."""
    prune = round(1000 * (1 - step.count / count))
    return Step(
        choice=Choice(prune, min(round(1000 * (step.count - step.sh_count) / count), 1000 - prune)),
        size=step.size,
        measurement=step.measurement,
        excess=step.excess,
        phase="multiplier",
        seconds=step.seconds,
    )


def _as_search(found: RateResult[Any], count: int) -> SearchResult:
    steps = tuple(as_step(step, count) for step in found.steps)
    return SearchResult(steps[found.steps.index(found.chosen)], found.reached, steps)
