"""The method for other programs' formats: every step writes a file, reads it back and measures it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from flexgs_edge.goals.steps import SearchResult, Step
from flexgs_edge.goals.target import Target
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.method import search_best
from flexgs_edge.methods.best.poses import ScoredPoses
from flexgs_edge.methods.foreign.by_cost import file_search
from flexgs_edge.methods.foreign.by_rank import search_pruned_files
from flexgs_edge.methods.foreign.file_maker import FileMaker, WrittenFile
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.source import SceneSource


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
