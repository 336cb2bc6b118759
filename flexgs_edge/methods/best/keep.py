"""Scenes that were compressed before: kept as they are where they fit the target."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.steps import SearchResult, Step
from flexgs_edge.goals.target import Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.on_grid import on_grid, steps_of
from flexgs_edge.grid.values import from_grid
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.method import LOG
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.judge import Judge, measurement_of
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource

LAYERS_COST = 1.06
"""Bytes of a layered file over those of one without, at most: neighbours on the curve are farther apart (1.052 for fox in four
layers)."""
KEPT_COPIES = 4
"""Times a scene's planes that looking for its grid holds: as read, in order, decoded, and codes."""


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
