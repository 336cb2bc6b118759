"""`--method best`: measured costs along a path of prune and rescore, one multiplier, grids of equal slope, the real coder."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

import numpy as np

from flexgs_edge.adapt import Measurement, SearchResult, Step, Target
from flexgs_edge.best.choice import BitModel
from flexgs_edge.best.effort import EFFORTS
from flexgs_edge.best.layers import assign_layers
from flexgs_edge.best.path import PrunePath
from flexgs_edge.best.search import MultiplierSearch, Product, RateResult, RateSearch, RateStep
from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera
from flexgs_edge.codec.container2 import coded_parts
from flexgs_edge.constants import ALPHA_MIN
from flexgs_edge.grid import GridScene
from flexgs_edge.pipeline.foreign import FileMaker, WrittenFile, search_pruned_files
from flexgs_edge.pipeline.foreign_best import FileSearch
from flexgs_edge.pipeline.judge import Judge, measurement_of
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.pipeline.workspace import Stopwatch
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.prune import Choice
from flexgs_edge.render import Renderer
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource

COPIES = 3
"""Copies of the scene's planes that the path holds at most: the scene, the snapshots together, and one in work (measured on fox:
snapshots at 0.8 of each other sum to four scenes less what the smallest ones share)."""


LAYERS_COST = 1.05
"""Bytes of a layered file over those of one without, at most: neighbours on the curve are farther apart."""
SETTINGS_MOST = 1536
"""Bytes that the settings in the header take at most: the search counts them before they are known."""


Measure = Callable[[dict[str, np.ndarray]], Measurement]
Report = Callable[[RateStep], None]
SearchMaker = Callable[[PrunePath, Measure, Report], MultiplierSearch[Product]]


def grid_search(options: CompressOptions) -> SearchMaker[GridScene]:
    """Searches for the grid of a `.fgs`."""

    def size_of(grid: GridScene) -> tuple[int, BitModel]:
        size, bits = size_and_bits(grid)
        return (size if options.layers == 1 else round(LAYERS_COST * size)), bits

    plan = EFFORTS[options.effort]
    return lambda path, measure, report: RateSearch(path, size_of, measure, plan, options.refit, report)


def file_search(options: CompressOptions, files: FileMaker) -> SearchMaker[WrittenFile]:
    """Searches for a file of another program's format."""
    plan = EFFORTS[options.effort]
    return lambda path, measure, report: FileSearch(path, files, measure, plan, options.refit, report)


def scored_poses(cameras: list[Camera], options: CompressOptions) -> list[Camera]:
    """As many poses as the effort scores, evenly spread."""
    count = min(EFFORTS[options.effort].views, len(cameras))
    return [cameras[i * len(cameras) // count] for i in range(count)]


def search_best(
    make: SearchMaker[Product],
    renderer: Renderer,
    source: SceneSource,
    cameras: list[Camera],
    judge: Judge,
    target: Target,
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    on_step: Callable[[Step], None] | None = None,
    progress: Progress = SILENT,
) -> tuple[Product, SearchResult]:
    """What to write, and the steps that led to it.

    Parameters
    ----------
    make : callable
        `grid_search` or `file_search`.
    source : SceneSource
        A checked scene; held in memory as a whole.
    cameras : list of Camera
        Training poses; at most as many as the effort scores are used, evenly spread.
    judge : Judge
        Prepared on the views that decide.

    Raises
    ------
    TargetError
        When nothing holds and `best_effort` is not set.
    BudgetError
        When the scene does not fit.
    """
    scored = scored_poses(cameras, options)
    size = COPIES * source.count * sum(4 * field.width(source.sh_degree) for field in FIELD.values())
    budget.take("the scene and its path", size)
    try:
        planes = source.read(slice(0, source.count), list(FIELD))
        with ExitStack() as stack:
            with clock.stage("references"), renderer.load(source) as scene:
                targets = stack.enter_context(TargetViews(renderer, scene, scored, progress=progress))
            with clock.stage("search"):
                rows = np.flatnonzero(alive(planes["opacity_logits"][0]))
                path = PrunePath(
                    renderer,
                    planes,
                    rows,
                    source.origin,
                    scored,
                    targets,
                    refit=options.refit,
                    unseen=options.unseen_share,
                    progress=progress,
                )

                def measure(kept: dict[str, np.ndarray]) -> Measurement:
                    with renderer.load(MemorySource(kept, origin=source.origin)) as kept_scene:
                        return measurement_of(judge.compare(kept_scene))

                def report(step: RateStep) -> None:
                    if on_step:
                        on_step(as_step(step, source.count))

                found = make(path, measure, report).run(target, options.best_effort)
        return found.product, _as_search(found, source.count)
    finally:
        budget.give(size)


def search_files(
    files: FileMaker,
    order: np.ndarray | None,
    renderer: Renderer | None,
    source: SceneSource,
    cameras: list[Camera],
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
    assert renderer is not None and judge is not None and target is not None
    make = file_search(options, files)
    return search_best(
        make, renderer, source, cameras, judge, target, options, budget, clock, on_step=on_step, progress=progress
    )


def layered(
    grid: GridScene, renderer: Renderer, cameras: list[Camera], options: CompressOptions, progress: Progress = SILENT
) -> GridScene:
    """The grid in as many layers as asked for."""
    poses = scored_poses(cameras, options)
    return assign_layers(grid, options.layers, size_and_bits(grid)[1], renderer, poses, progress)


def alive(logits: np.ndarray) -> np.ndarray:
    """[n] bool: opacity reaches 1/255 (the renderer culls the rest everywhere, so they go first and cost nothing)."""
    return logits >= np.float32(-np.log(1 / ALPHA_MIN - 1) - 1e-3)


def size_and_bits(grid: GridScene) -> tuple[int, BitModel]:
    """Exact bytes of a grid's file, and what its Gaussians cost.

    The bytes of the SH are shared among their coefficients; the rest among the rows.
    """
    size, sh = coded_parts(grid, {})
    size += SETTINGS_MOST
    base = size - sh
    rows = [int(np.count_nonzero(grid.sh_degrees >= level)) for level in range(1, grid.sh_degree + 1)]
    values = sum((2 * level + 1) * count for level, count in enumerate(rows, start=1))
    each = 8 * sh / max(values, 1)
    return size, BitModel(
        8 * base / max(grid.count, 1), tuple((2 * level + 1) * each for level in range(1, grid.sh_degree + 1))
    )


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
