"""`--method best`: measured costs along a path of prune and rescore, one multiplier, grids of equal slope, the real coder."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np

from flexgs_edge.adapt import Measurement, SearchResult, Step, Target
from flexgs_edge.best.choice import BitModel
from flexgs_edge.best.effort import EFFORTS
from flexgs_edge.best.layers import assign_layers
from flexgs_edge.best.path import PARTS, PrunePath, sums_room
from flexgs_edge.best.search import MultiplierSearch, Product, RateResult, RateSearch, RateStep
from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera
from flexgs_edge.cameras.between import poses_between
from flexgs_edge.cameras.order import farthest_order
from flexgs_edge.codec.container2 import coded_parts
from flexgs_edge.constants import ALPHA_MIN
from flexgs_edge.grid import GridScene
from flexgs_edge.kernels import Backend
from flexgs_edge.pipeline.foreign import FileMaker, WrittenFile, search_pruned_files
from flexgs_edge.pipeline.foreign_best import FileSearch
from flexgs_edge.pipeline.judge import Judge, measurement_of
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.pipeline.workspace import Stopwatch, coding_device
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.prune import Choice
from flexgs_edge.refit import descent_bytes
from flexgs_edge.render import Renderer
from flexgs_edge.render.device_scene import plane_bytes
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource

COST_BYTES = 16
"""Costs of a row and snapshot beside those of its SH: removal and weight, in double precision."""
BAND_BYTES = 20
"""The same for each SH degree: a cost in double precision, a mean colour."""
WORK_PLANES = 11
"""What a whole result holds for a moment, in planes of its rows (at degree 3, of 236 bytes): the rows without what was dropped,
codes, values of codes twice, colours of the last refit and of this one, and sums of the refit twice. With 6, fox at a fidelity
of 48 dB (nearly all rows stay) had a peak 90 MiB above its limit, with 9 one of 12 MiB."""


DESCENTS = 3
"""Times the scene's stored planes that the values of all descents take: two results at 0.1 dB, six or more at 1 dB."""
LAYERS_COST = 1.06
"""Bytes of a layered file over those of one without, at most: neighbours on the curve are farther apart (1.052 for fox in four
layers)."""
SETTINGS_MOST = 1536
"""Bytes that the settings in the header take at most: the search counts them before they are known."""


Measure = Callable[[dict[str, np.ndarray]], Measurement]
Report = Callable[[RateStep], None]
SearchMaker = Callable[[PrunePath, Measure, Report], MultiplierSearch[Product]]


def grid_search(
    options: CompressOptions, search: type[RateSearch] = RateSearch, renderer: Renderer | None = None
) -> SearchMaker[GridScene]:
    """Searches for the grid of a `.fgs`; the renderer's device codes where it can."""

    def size_of(grid: GridScene) -> tuple[int, BitModel]:
        device = None if renderer is None else coding_device(renderer.backend, renderer.budget, grid)
        size, bits = size_and_bits(grid, device)
        return (size if options.layers == 1 else round(LAYERS_COST * size)), bits

    plan = EFFORTS[options.effort]

    def make(path: PrunePath, measure: Measure, report: Report) -> MultiplierSearch[GridScene]:
        steps = distil_steps(options, len(path.cameras))
        return search(path, size_of, measure, plan, options.refit, report, steps)

    return make


def distil_steps(options: CompressOptions, poses: int) -> int:
    """Steps of the descent to the first whole result; 0 for none."""
    return round(EFFORTS[options.effort].passes * poses) if options.distil is None else options.distil


def file_search(options: CompressOptions, files: FileMaker) -> SearchMaker[WrittenFile]:
    """Searches for a file of another program's format."""
    plan = EFFORTS[options.effort]
    return lambda path, measure, report: FileSearch(path, files, measure, plan, options.refit, report)


def scored_poses(cameras: Sequence[Camera], options: CompressOptions) -> list[Camera]:
    """As many poses as the effort scores, farthest first.

    Names often go round a scene in rings: 8 of the sample's 70 poses evenly spread by name lost 7.8 dB where these lose 1.0 at
    the same bytes (docs/performance.md).
    """
    return [cameras[i] for i in farthest_order(cameras)[: EFFORTS[options.effort].views]]


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
        Training poses; at most as many as the effort scores are used, farthest first.
    judge : Judge
        Prepared on the views that decide.

    Raises
    ------
    TargetError
        When nothing holds and `best_effort` is not set.
    BudgetError
        When the scene does not fit.
    """
    with open_path(renderer, source, cameras, options, budget, clock, progress) as path, clock.stage("search"):
        return search_path(make, path, renderer, source, judge, target, options, on_step)


@contextmanager
def open_path(
    renderer: Renderer,
    source: SceneSource,
    cameras: Sequence[Camera],
    options: CompressOptions,
    budget: MemoryBudget,
    clock: Stopwatch,
    progress: Progress = SILENT,
    make: Callable[..., PrunePath] = PrunePath,
) -> Iterator[PrunePath]:
    """The path that searches walk, at its start; several targets may share it, the weakest compression first.

    Parameters
    ----------
    make : callable, optional
        Builds the path from the arguments of `PrunePath`.
    """
    scored = scored_poses(cameras, options)
    size = source.count * row_bytes(source.sh_degree, EFFORTS[options.effort].keep)
    largest = max(scored, key=lambda camera: camera.width * camera.height)
    steps = distil_steps(options, len(scored))
    sums = sums_room(source.sh_degree)
    if steps:
        # A descent holds what is kept, with all that it remembers, at once: as much as the whole scene at the most.
        sums = max(sums, descent_bytes(source.sh_degree) + plane_bytes(source.sh_degree))
        size += source.count * DESCENTS * stored_bytes(source.sh_degree)
    budget.require("a search by measured costs", size + renderer.least_bytes(source, largest, sums))
    budget.take("the scene and its path", size)
    try:
        planes = source.read(slice(0, source.count), list(FIELD))
        with TargetViews() as targets:
            with clock.stage("search"):
                rows = np.flatnonzero(alive(planes["opacity_logits"][0]))
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

    def measure(kept: dict[str, np.ndarray]) -> Measurement:
        with renderer.load(MemorySource(kept, origin=source.origin)) as kept_scene:
            return measurement_of(judge.compare(kept_scene))

    def report(step: RateStep) -> None:
        if on_step:
            on_step(as_step(step, source.count))

    found = make(path, measure, report).run(target, options.best_effort)
    return found.product, _as_search(found, source.count)


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
    return assign_layers(
        grid,
        options.layers,
        size_and_bits(grid, coding_device(renderer.backend, renderer.budget, grid))[1],
        renderer,
        poses,
        progress,
    )


def stored_bytes(sh_degree: int) -> int:
    """Bytes of a row's stored planes."""
    return sum(4 * field.width(sh_degree) for field in FIELD.values())


def row_bytes(sh_degree: int, keep: float) -> int:
    """Bytes that a search holds for each row of its scene, at most, beside what the renderer counts.

    Either snapshots down to nothing, each `keep` of the one before; or, when nearly all is kept, one of them and all that a
    whole result of it needs. What lies between is between.
    """
    planes = stored_bytes(sh_degree)
    snapshot = planes + COST_BYTES + BAND_BYTES * sh_degree
    parts = PARTS * 8 * (2 + 4 * sh_degree)
    return round(max(snapshot / (1 - keep), snapshot + WORK_PLANES * planes)) + parts


def alive(logits: np.ndarray) -> np.ndarray:
    """[n] bool: opacity reaches 1/255 (the renderer culls the rest everywhere, so they go first and cost nothing)."""
    return logits >= np.float32(-np.log(1 / ALPHA_MIN - 1) - 1e-3)


def size_and_bits(grid: GridScene, device: Backend | None = None) -> tuple[int, BitModel]:
    """Exact bytes of a grid's file, and what its Gaussians cost.

    The bytes of the SH are shared among their coefficients; the rest among the rows.
    """
    size, sh = coded_parts(grid, {}, device=device)
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
