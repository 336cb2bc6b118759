"""Keeps a scene that was compressed before as it is, if it already fits a target of bytes.

Another search would prune and round it once more, and lose quality for nothing.
"""

from __future__ import annotations

import logging
import time
from dataclasses import replace

from flexgs_edge.codec.v2.header import PREVIEW_KEY
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.steps import SearchResult, Step
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.on_grid import on_grid, steps_of
from flexgs_edge.grid.values import from_grid
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.run.judge import Judge, measurement_of
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.run.settings import make_settings
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.bench import Bench

LOG = logging.getLogger("flexgs_edge")

LAYERS_COST = 1.06
"""Most bytes of a layered file over those of a file without layers: neighbours on the curve are farther apart in it.
docs/results/tuning.md#layers_cost"""
KEPT_COPIES = 4
"""Copies of a scene's planes that looking for its grid holds: as read, in order, decoded, and codes."""


def reckoned(options: CompressOptions, size: int) -> int:
    """Bytes that a search reckons with for a file of `size` bytes, with the layers and the preview that were asked for.

    A preview by default comes only where it fits.
    """
    cost = 1.0 if options.layers in (None, 1) else LAYERS_COST
    return round(cost * size) + with_preview(options.preview or 0)


def with_preview(size: int) -> int:
    """Most bytes by which a preview of `size` bytes makes a file longer; 0 if there is none."""
    return size + PREVIEW_KEY if size else 0


def kept_as_it_is(
    run: Run[CompressOptions], bench: Bench, coder: GridCoder, judge: Judge, settings_known: bool = True
) -> tuple[GridScene, SearchResult] | None:
    """The scene on its old grid if it was compressed before and already fits the target's bytes; else None.

    Nothing is lost then. Another search would prune and round the scene once more:
    docs/results/tuning.md#kept-as-it-is.

    `run`: planned. Only a `.fgs`, or an unchanged PLY that a `.fgs` was decompressed to, lies on a grid. `bench`: draws
    the views. `coder`: tells the bytes of the file. `judge`: prepared on the views that decide. `settings_known`: the
    header will hold what `make_settings` returns (default). Otherwise the size leaves room for any settings.
    """
    source, target = run.source, run.target
    limit, steps = target.limit_bytes, steps_of(source.comments)
    most = source.count if run.options.max_gaussians is None else run.options.max_gaussians
    held = KEPT_COPIES * source.count * sum(4 * field.width(source.sh_degree) for field in FIELD.values())
    if (
        limit is None
        or steps is None
        or source.count > most
        or run.options.unseen_share < 1.0
        or held > run.budget.free
    ):
        return None
    started = time.perf_counter()
    grid = on_grid(source.read(slice(0, source.count), list(FIELD)), steps, source.origin)
    if grid is None:
        return None
    size = coder.size(grid, {})  # without settings: they hold the measurement, which is not there yet
    if reckoned(run.options, size) > limit:
        return None
    with bench.renderer.load(MemorySource(from_grid(grid), origin=grid.origin)) as scene:
        measurement = measurement_of(judge.compare(scene, with_ssim=True))
    without = 1000 - min(round(1000 * grid.sh_count / grid.count), 1000)
    seconds = time.perf_counter() - started
    step = Step(Choice(0, without), size, measurement, target.excess(size, measurement), "multiplier", seconds)
    settings = make_settings(run, SearchResult(step, True, (step,))) if settings_known else None
    size = coder.size(grid, settings)
    if reckoned(run.options, size) > limit:
        return None
    LOG.info("the scene was compressed before and fits: it stays as it is")
    step = replace(step, size=size, excess=target.excess(size, measurement))
    return grid, SearchResult(step, True, (step,))
