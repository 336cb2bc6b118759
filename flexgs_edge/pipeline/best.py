"""`--method best`: measured costs along a path of prune and rescore, one multiplier, grids of equal slope, the real coder."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flexgs_edge.adapt import Measurement, Scored, SearchResult, Step, Target
from flexgs_edge.best.checkpoint import Checkpoint
from flexgs_edge.best.effort import EFFORTS
from flexgs_edge.best.layers import assign_layers
from flexgs_edge.best.path import PrunePath
from flexgs_edge.best.search import Measure, MultiplierSearch, Product, RateResult, RateSearch, RateStep
from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera
from flexgs_edge.cameras.made import poses_between
from flexgs_edge.constants import ALPHA_MIN
from flexgs_edge.curve import near_rows
from flexgs_edge.grid import GridScene, from_grid
from flexgs_edge.pipeline.foreign import FileMaker, WrittenFile, search_pruned_files
from flexgs_edge.pipeline.foreign_best import FileSearch
from flexgs_edge.pipeline.grid_coder import GridCoder
from flexgs_edge.pipeline.judge import Judge, measurement_of
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.pipeline.poses import ScoredPoses
from flexgs_edge.pipeline.room import SPILLED_ROW_BYTES, distil_steps, largest_of, least_spilled, needed_bytes
from flexgs_edge.pipeline.workspace import Stopwatch
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.prune import Choice
from flexgs_edge.regrid import on_grid, steps_of
from flexgs_edge.render import Renderer
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource, read_all

LOG = logging.getLogger("flexgs_edge")

LAYERS_COST = 1.06
"""Bytes of a layered file over those of one without, at most: neighbours on the curve are farther apart (1.052 for fox in four
layers)."""
KEPT_COPIES = 4
"""Times a scene's planes that looking for its grid holds: as read, in order, decoded, and codes."""
Report = Callable[[RateStep], None]
SearchMaker = Callable[[PrunePath, Measure, Report], MultiplierSearch[Product]]


def grid_search(
    options: CompressOptions, coder: GridCoder, search: type[RateSearch] = RateSearch
) -> SearchMaker[GridScene]:
    """Searches for the grid of a `.fgs`."""

    def size_of(grid: GridScene) -> int:
        size = coder.size(grid)
        return size if options.layers == 1 else round(LAYERS_COST * size)

    plan = EFFORTS[options.effort]

    def make(path: PrunePath, measure: Measure, report: Report) -> MultiplierSearch[GridScene]:
        steps = distil_steps(options, len(path.cameras))
        return search(path, size_of, measure, plan, options.refit, report, steps)

    return make


def file_search(options: CompressOptions, files: FileMaker) -> SearchMaker[WrittenFile]:
    """Searches for a file of another program's format."""
    plan = EFFORTS[options.effort]
    return lambda path, measure, report: FileSearch(path, files, measure, plan, options.refit, report)


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
        A checked scene; held in `renderer.room` as a whole.
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
    path_of = open_path(renderer, source, poses.cameras, options, budget, clock, progress, checkpoint=checkpoint)
    with path_of as path, clock.stage("search"):
        product, search = search_path(make, path, renderer, source, judge, target, options, on_step)
        return product, replace(search, scored=Scored(len(poses.cameras), poses.made, path.unseen))


def kept_as_it_is(
    coder: GridCoder,
    renderer: Renderer,
    source: SceneSource,
    judge: Judge,
    target: Target,
    options: CompressOptions,
    budget: MemoryBudget,
    settings_of: Callable[[SearchResult], Mapping[str, Any] | None],
) -> tuple[GridScene, SearchResult] | None:
    """A scene that lies on a grid of ours and fits the target's bytes already, with nothing lost; else None.

    So it is for files that were compressed before. Another search would prune and round what is pruned and rounded: five
    generations of the sample scene, each asked for the bytes of the first, lost 0.63 dB more than the first.

    Parameters
    ----------
    source : SceneSource
        A `.fgs`, or a PLY that one was decompressed to and nobody changed.
    settings_of : callable
        What the file would say of itself (None: not known), so that its size is known to the byte.
    """
    limit, steps = target.limit_bytes, steps_of(source.comments)
    held = KEPT_COPIES * source.count * sum(4 * field.width(source.sh_degree) for field in FIELD.values())
    if limit is None or steps is None or options.unseen_share < 1.0 or held > budget.free:
        return None
    started = time.perf_counter()
    grid = on_grid(source.read(slice(0, source.count), list(FIELD)), steps, source.origin)
    if grid is None:
        return None
    layers_cost = 1.0 if options.layers == 1 else LAYERS_COST
    size = coder.size(grid, {})  # without what the file says of itself, which holds the measurement
    if round(layers_cost * size) > limit:
        return None
    with renderer.load(MemorySource(from_grid(grid), origin=grid.origin)) as scene:
        measurement = measurement_of(judge.compare(scene, with_ssim=judge.reports))
    without = 1000 - min(round(1000 * grid.sh_count / grid.count), 1000)
    seconds = time.perf_counter() - started
    step = Step(Choice(0, without), size, measurement, target.excess(size, measurement), "multiplier", seconds)
    size = coder.size(grid, settings_of(SearchResult(step, True, (step,))))
    if round(layers_cost * size) > limit:
        return None
    LOG.info("the scene was compressed before and fits: it stays as it is")
    step = replace(step, size=size, excess=target.excess(size, measurement))
    return grid, SearchResult(step, True, (step,))


@contextmanager
def open_path(
    renderer: Renderer,
    source: SceneSource,
    scored: Sequence[Camera],
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    progress: Progress = SILENT,
    make: Callable[..., PrunePath] = PrunePath,
    checkpoint: Checkpoint | None = None,
) -> Iterator[PrunePath]:
    """The path that searches walk, at its start; several targets may share it, the weakest compression first.

    Parameters
    ----------
    scored : sequence of Camera
        From `scored_poses`.
    make : callable, optional
        Builds the path from the arguments of `PrunePath`.
    checkpoint : Checkpoint, optional
        Where the path keeps its rounds.
    """
    room, steps = renderer.room, distil_steps(options, len(scored))
    if room.spills:
        size, least = SPILLED_ROW_BYTES * source.count, least_spilled(renderer, source, largest_of(scored))
    else:
        size, least = needed_bytes(renderer, source, scored, options)
    budget.require("a search by measured costs", size + least)
    budget.take("the scene and its path", size)
    try:
        planes = read_all(source, room)
        with TargetViews(room.folder) as targets:
            with clock.stage("search"):
                rows = np.flatnonzero(alive(planes["opacity_logits"][0]))
                # Neighbours in space become neighbours in memory: a view of fox takes a seventh less.
                rows = room.take(rows, near_rows(room.take(planes["means"], rows), room))
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


def search_path(
    make: SearchMaker[Product],
    path: PrunePath,
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

    def report(step: RateStep) -> None:
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


def search_files(
    files: FileMaker,
    order: np.ndarray | None,
    renderer: Renderer | None,
    source: SceneSource,
    poses: ScoredPoses | None,
    judge: Judge | None,
    target: Target | None,
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    on_step: Callable[[Step], None] | None = None,
    progress: Progress = SILENT,
) -> tuple[WrittenFile, SearchResult]:
    """A file of another program's format: in rank order ([N] i64, least important row first), or by measured costs (None)."""
    if order is not None:
        with clock.stage("search"):
            return search_pruned_files(files, source, order, target, options, on_step)
    assert renderer is not None and judge is not None and target is not None and poses is not None
    make = file_search(options, files)
    return search_best(
        make, renderer, source, poses, judge, target, options, budget, clock, on_step=on_step, progress=progress
    )


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


def as_step(step: RateStep, count: int) -> Step:
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
