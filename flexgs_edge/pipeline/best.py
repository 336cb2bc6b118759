"""`--method best`: measured costs along a path of prune and rescore, one multiplier, grids of equal slope, the real coder."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.adapt import Measurement, Scored, SearchResult, Step, Target
from flexgs_edge.best.checkpoint import Checkpoint
from flexgs_edge.best.choice import BitModel
from flexgs_edge.best.effort import EFFORTS
from flexgs_edge.best.layers import assign_layers
from flexgs_edge.best.path import PARTS, PrunePath, sums_room
from flexgs_edge.best.search import Measure, MultiplierSearch, Product, RateResult, RateSearch, RateStep
from flexgs_edge.budget import MemoryBudget, format_size
from flexgs_edge.cameras import Camera
from flexgs_edge.codec.coder import Encoded, encode_grid
from flexgs_edge.codec.container2 import coded_parts, write_grid
from flexgs_edge.constants import ALPHA_MIN
from flexgs_edge.grid import GridScene, from_grid, near_rows, on_grid, steps_of
from flexgs_edge.pipeline.foreign import FileMaker, WrittenFile, search_pruned_files
from flexgs_edge.pipeline.foreign_best import FileSearch
from flexgs_edge.pipeline.judge import Judge, measurement_of
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.pipeline.poses import ScoredPoses
from flexgs_edge.pipeline.workspace import Stopwatch, coding_device
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.prune import Choice
from flexgs_edge.render import Renderer, sum_bytes
from flexgs_edge.render.device_scene import COMPACT_ROWS, MOST_SUMS
from flexgs_edge.render.renderer import FIRST_SHARE
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.score.cache import fingerprint
from flexgs_edge.scratch import MEMORY, Room, Scratch

LOG = logging.getLogger("flexgs_edge")

COST_BYTES = 16
"""Costs of a row and snapshot beside those of its SH: removal and weight, in double precision."""
BAND_BYTES = 20
"""The same for each SH degree: a cost in double precision, a mean colour."""
WORK_PLANES = 11
"""What a whole result holds for a moment, in planes of its rows (at degree 3, of 236 bytes): the rows without what was dropped,
codes, values of codes twice, colours of the last refit and of this one, and sums of the refit twice. With 6, fox at a fidelity
of 48 dB (nearly all rows stay) had a peak 90 MiB above its limit, with 9 one of 12 MiB."""


LAYERS_COST = 1.06
"""Bytes of a layered file over those of one without, at most: neighbours on the curve are farther apart (1.052 for fox in four
layers)."""
KEPT_COPIES = 4
"""Times a scene's planes that looking for its grid holds: as read, in order, decoded, and codes."""
SETTINGS_MOST = 1536
"""Bytes that the settings in the header take at most: the search counts them before they are known."""


SPILLED_ROW_BYTES = 24
"""Bytes that each row of a scene in scratch files takes of memory for a moment: choosing the cheapest rows, and lists of rows."""
SPOOL_ROW_BYTES = 52
"""Bytes that each row that a view shows takes of the scratch file for its sums (`ViewSums`)."""


Report = Callable[[RateStep], None]
SearchMaker = Callable[[PrunePath, Measure, Report], MultiplierSearch[Product]]


class GridCoder:
    """Codes the grids of a search. The last one stays coded, so that writing it is copying.

    Parameters
    ----------
    renderer : Renderer
        Its device codes where it can.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._last: tuple[GridScene, Encoded] | None = None

    def encoded(self, grid: GridScene) -> Encoded:
        """The grid as it will lie in a file."""
        if self._last is None or self._last[0] is not grid:
            self._last = None
            device = coding_device(self._renderer.backend, self._renderer.budget, grid)
            encoded = encode_grid(grid, device=device, room=self._renderer.room)
            # Of a scene in scratch files even the bytes of the file may be too many.
            self._last = grid, encoded if self._renderer.room.spills else encoded.finished()
        return self._last[1]

    def size_and_bits(self, grid: GridScene) -> tuple[int, BitModel]:
        """See `size_and_bits`."""
        return size_and_bits(grid, self.encoded(grid))

    def size(self, grid: GridScene, settings: Mapping[str, Any]) -> int:
        """Bytes of the file that `write` makes."""
        return coded_parts(grid, settings, encoded=self.encoded(grid))[0]

    def write(self, path: str | os.PathLike[str], grid: GridScene, settings: Mapping[str, Any]) -> int:
        """See `write_grid`."""
        return write_grid(path, grid, settings, encoded=self.encoded(grid))


def grid_search(
    options: CompressOptions, coder: GridCoder, search: type[RateSearch] = RateSearch
) -> SearchMaker[GridScene]:
    """Searches for the grid of a `.fgs`."""

    def size_of(grid: GridScene) -> tuple[int, BitModel]:
        size, bits = coder.size_and_bits(grid)
        return (size if options.layers == 1 else round(LAYERS_COST * size)), bits

    plan = EFFORTS[options.effort]
    return lambda path, measure, report: search(path, size_of, measure, plan, options.refit, report)


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
) -> tuple[GridScene, SearchResult] | None:
    """A scene that lies on a grid of ours and fits the target's bytes already, with nothing lost; else None.

    So it is for files that were compressed before. Another search would prune and round what is pruned and rounded: five
    generations of the sample scene, each asked for the bytes of the first, lost 0.63 dB more than the first.

    Parameters
    ----------
    source : SceneSource
        A `.fgs`, or a PLY that one was decompressed to and nobody changed.
    """
    limit, steps = target.limit_bytes, steps_of(source.comments)
    size = KEPT_COPIES * source.count * sum(4 * field.width(source.sh_degree) for field in FIELD.values())
    if limit is None or steps is None or options.unseen_share < 1.0 or size > budget.free:
        return None
    started = time.perf_counter()
    grid = on_grid(source.read(slice(0, source.count), list(FIELD)), steps, source.origin)
    if grid is None:
        return None
    found, _ = coder.size_and_bits(grid)
    if (found if options.layers == 1 else round(LAYERS_COST * found)) > limit:
        return None
    with renderer.load(MemorySource(from_grid(grid), origin=grid.origin)) as scene:
        measurement = measurement_of(judge.compare(scene))
    LOG.info("the scene was compressed before and fits: it stays as it is")
    without = 1000 - min(round(1000 * grid.sh_count / grid.count), 1000)
    seconds = time.perf_counter() - started
    step = Step(Choice(0, without), found, measurement, target.excess(found, measurement), "multiplier", seconds)
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
    room, largest = renderer.room, largest_of(scored)
    if room.spills:
        size, least = SPILLED_ROW_BYTES * source.count, least_spilled(renderer, source, largest)
    else:
        size = source.count * row_bytes(source.sh_degree, EFFORTS[options.effort].keep)
        least = renderer.least_bytes(source, largest, sums_room(source.sh_degree))
    budget.require("a search by measured costs", size + least)
    budget.take("the scene and its path", size)
    try:
        planes = {name: room.empty((source.width(name), source.count), np.float32) for name in FIELD}
        source.read(slice(0, source.count), list(FIELD), planes)
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

    def measure(kept: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        with renderer.load(MemorySource(kept, origin=source.origin)) as kept_scene:
            return measurement_of(judge.estimate(kept_scene) if estimate else judge.compare(kept_scene))

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
        GridCoder(renderer).size_and_bits(grid)[1],
        renderer,
        poses.cameras,
        progress,
    )


def choose_room(
    renderer: Renderer,
    source: SceneSource,
    scored: Sequence[Camera],
    options: CompressOptions,
    budget: MemoryBudget,
    folder: Path,
) -> Room:
    """Memory, where the scene and the path of its search fit, else scratch files; says which, and how much they may take.

    Parameters
    ----------
    folder : path
        For scratch files.

    Raises
    ------
    BudgetError
        When not even the views fit, or the disk is too small.
    """
    largest = largest_of(scored)
    rows, keep = source.count, EFFORTS[options.effort].keep
    whole = rows * row_bytes(source.sh_degree, keep)
    if whole + renderer.least_bytes(source, largest, sums_room(source.sh_degree)) <= budget.free:
        return MEMORY
    budget.require(
        "a search by measured costs with all else in scratch files",
        SPILLED_ROW_BYTES * rows + least_spilled(renderer, source, largest),
    )
    room = Scratch(folder)
    renderer.largest = largest
    spooled = SPOOL_ROW_BYTES * rows * len(scored)
    LOG.info(
        "%d Gaussians and the path of their search need %s in memory, %s are free: they go to scratch files in %s "
        "(at most about %s; --scratch names another folder), %d rows at a time; %d bytes of each Gaussian and views of the "
        "Gaussians that they show stay in memory; %d passes over %d poses",
        rows, format_size(whole), format_size(budget.free), room.folder, format_size(whole + spooled), COMPACT_ROWS,
        SPILLED_ROW_BYTES, 2 + EFFORTS[options.effort].refit_rounds, len(scored),
    )  # fmt: skip
    return room


def open_checkpoint(
    renderer: Renderer, source: SceneSource, scored: Sequence[Camera], options: CompressOptions, folder: Path
) -> Checkpoint:
    """Where the path of a search keeps its rounds: a folder named by all that they depend on."""
    words = f"path {EFFORTS[options.effort].keep!r} {options.refit} {options.unseen_share!r} {renderer.background!r}"
    assert options.near is not None and options.extent is not None
    key = fingerprint(source, scored, words, options.near, options.extent, bool(options.antialiased), list(FIELD))
    checkpoint = Checkpoint(folder / f".flexgs-resume-{key[:16]}")
    if checkpoint.rounds:
        LOG.info(
            "%s: an earlier run was cut short after %d rounds: going on from there",
            checkpoint.folder,
            checkpoint.rounds,
        )
    return checkpoint


def least_spilled(renderer: Renderer, source: SceneSource, largest: Camera) -> int:
    """Bytes that the first view of a search in scratch files needs; one that shows more than `FIRST_SHARE` says needs more."""
    return renderer.compact_bytes(source, largest, -(-source.count // FIRST_SHARE), sum_bytes(MOST_SUMS))


def largest_of(cameras: Sequence[Camera]) -> Camera:
    """The camera with most pixels."""
    return max(cameras, key=lambda camera: camera.width * camera.height)


def row_bytes(sh_degree: int, keep: float) -> int:
    """Bytes that a search holds for each row of its scene, at most, beside what the renderer counts.

    Either snapshots down to nothing, each `keep` of the one before; or, when nearly all is kept, one of them and all that a
    whole result of it needs. What lies between is between.
    """
    planes = sum(4 * field.width(sh_degree) for field in FIELD.values())
    snapshot = planes + COST_BYTES + BAND_BYTES * sh_degree
    parts = PARTS * 8 * (2 + 4 * sh_degree)
    return round(max(snapshot / (1 - keep), snapshot + WORK_PLANES * planes)) + parts


def alive(logits: np.ndarray) -> np.ndarray:
    """[n] bool: opacity reaches 1/255 (the renderer culls the rest everywhere, so they go first and cost nothing)."""
    return logits >= np.float32(-np.log(1 / ALPHA_MIN - 1) - 1e-3)


def size_and_bits(grid: GridScene, encoded: Encoded | None = None) -> tuple[int, BitModel]:
    """Exact bytes of a grid's file, and what its Gaussians cost.

    The bytes of the SH are shared among their coefficients; the rest among the rows.
    """
    size, sh = coded_parts(grid, {}, encoded=encoded)
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
