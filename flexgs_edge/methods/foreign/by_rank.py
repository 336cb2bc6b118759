"""Files of other formats by rank order, for `--method paper`: a search along the prune rate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence

import numpy as np

from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.line import LINE_STEPS, START, search_line
from flexgs_edge.goals.steps import MAX_PRUNE, Phase, SearchResult, Step, better, out_of_reach
from flexgs_edge.goals.target import Target
from flexgs_edge.io.exchange import near_order
from flexgs_edge.methods.foreign.file_maker import LOG, FileMaker, WrittenFile
from flexgs_edge.methods.paper.prune import nonzero_sh, ranks_from_order, select_rows
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.lower_sh import TrimmedSource
from flexgs_edge.scene.source import SceneSource

SH_A_PRUNE = {".spz": 0.5, ".sog": 1.5}
"""SH rate divided by prune rate. It is larger where SH take more of the bytes, because pruning loses more quality than
dropping SH. Formats with one SH degree for all Gaussians have none: docs/results/tuning.md#sh_a_prune"""


def search_pruned_files(
    files: FileMaker,
    source: SceneSource,
    order: np.ndarray,
    target: Target | None,
    options: CompressOptions,
    on_step: Callable[[Step], None] | None = None,
) -> tuple[WrittenFile, SearchResult]:
    """Search for the file that meets a target by pruning in rank order.

    The search goes along the prune rate: once, or once for each SH degree if the format has one degree for all Gaussians.

    Parameters
    ----------
    files : FileMaker
        Writes, reads back and measures.
    source : SceneSource
        The original.
    order : np.ndarray
        [N] i64, least important row first.
    target : Target or None
        `None` for fixed rates.
    options : CompressOptions
        Effort, fixed rates and `best_effort`.
    on_step : callable, optional
        Called with each step.

    Raises
    ------
    TargetError
        When nothing holds and `best_effort` is not set.
    """
    search = _PrunedFiles(files, source, order, target, on_step)
    if options.fixed is not None:
        search.measure(options.fixed, search.most_degree, "fixed")
    elif files.format.one_degree and search.most_degree:
        search.by_degrees(LINE_STEPS[options.effort])
    else:
        search.line(search.most_degree, LINE_STEPS[options.effort])
    assert search.best is not None
    chosen, file = search.best
    if target is not None and not chosen.holds and not options.best_effort:
        raise out_of_reach(target, chosen, source.count)
    return file, SearchResult(chosen, chosen.holds, tuple(search.steps))


class _PrunedFiles:
    """Makes files of a scene pruned by rank. Keeps the best one so far and removes the others."""

    def __init__(
        self,
        files: FileMaker,
        source: SceneSource,
        order: np.ndarray,
        target: Target | None,
        on_step: Callable[[Step], None] | None,
    ) -> None:
        self.files, self.source, self.target, self.on_step = files, source, target, on_step
        self.ranks, self.has_sh = ranks_from_order(order), nonzero_sh(source)
        self.most_degree = min(source.sh_degree, files.format.max_degree)
        self.steps: list[Step] = []
        self.best: tuple[Step, WrittenFile] | None = None

    def measure(self, choice: Choice, degree: int, phase: Phase = "line") -> Step:
        """Write, read back and measure the file of a choice, with SH up to `degree`."""
        started = time.perf_counter()
        with_sh, without = select_rows(self.ranks, choice, self.has_sh)
        keeps_sh = np.zeros(self.source.count, bool)
        keeps_sh[with_sh] = True
        rows = np.sort(np.concatenate([with_sh, without]))
        # Neighbours along the curve have similar bytes, so .spz files get smaller.
        rows = rows[near_order(self.source.select(rows))]
        file = self.files.make(TrimmedSource(self.source.select(rows), keeps_sh[rows], degree if with_sh.size else 0))
        excess = 0.0 if self.target is None else self.target.excess(file.size, file.measurement)
        step = Step(choice, file.size, file.measurement, excess, phase, time.perf_counter() - started)
        self.steps.append(step)
        if self.on_step:
            self.on_step(step)
        if self.best is None:
            self.best = (step, file)
        elif self.target is not None and better(step, self.best[0], self.target):
            self.best[1].path.unlink()
            self.best = (step, file)
        else:
            file.path.unlink()
        return step

    def line(self, degree: int, steps: int, known: Sequence[Step] = ()) -> None:
        """Search along the prune rate, with SH up to `degree`."""
        assert self.target is not None
        start = START
        if self.target.limit_bytes is not None:
            start = self.rate_for(self.target.limit_bytes, degree)
        search_line(lambda prune: self.measure(self.choice(prune, degree), degree), self.target, start, steps, known)

    def by_degrees(self, steps: int) -> None:
        """Search once for each SH degree that may win: few rows with many SH, or many rows with few SH."""
        assert self.target is not None
        top = self.most_degree
        if self.target.limit_bytes is not None:
            for degree in range(top + 1):
                LOG.info("SH up to degree %d:", degree)
                self.line(degree, steps)
            return
        for degree in range(top + 1):
            LOG.info("SH up to degree %d:", degree)
            whole = self.measure(self.choice(0, degree), degree)
            if whole.holds:
                self.line(degree, steps, [whole])
                break
        # A higher degree takes more bytes a row. It can only win if it holds at the prune rate of equal bytes.
        for more in range(degree + 1, top + 1):
            assert self.best is not None
            LOG.info("SH up to degree %d:", more)
            prune = self.rate_for(self.best[0].size, more)
            step = self.measure(self.choice(prune, more), more)
            if not step.holds:
                break
            self.line(more, steps, [step])

    def rate_for(self, size: int, degree: int) -> int:
        """Prune rate (thousandths) at which a file is expected to have `size` bytes."""
        format = self.files.format
        row = format.row_bytes - format.sh_bytes * (1 - sh_rest_count(degree) / sh_rest_count(3))
        share = size / (row * self.source.count)
        return max(0, min(MAX_PRUNE, math.ceil(1000 * (1 - share))))

    def choice(self, prune: int, degree: int) -> Choice:
        """The SH rate that goes with a prune rate."""
        if degree == 0:
            return Choice(prune, 1000 - prune)
        return Choice(prune, min(round(prune * SH_A_PRUNE.get(self.files.format.suffix, 0.0)), 1000 - prune))
