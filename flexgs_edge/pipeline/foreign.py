"""`compress` to other programs' formats: every step of the search writes a file, reads it back, and measures what came back.

No size of theirs can be told before the file is there, and their writers lose quality in their own ways, so files are what is
searched over; the best so far lies beside the output and takes its name at the end.
"""

from __future__ import annotations

import logging
import math
import os
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.adapt import Measurement, SearchResult, Step, Target
from flexgs_edge.adapt.line import LINE_STEPS, START, better, search_line
from flexgs_edge.adapt.search import MAX_PRUNE, Phase, out_of_reach
from flexgs_edge.budget import MemoryBudget
from flexgs_edge.errors import InputError
from flexgs_edge.formats import (
    Format,
    check_converter,
    converter_bytes,
    format_of,
    near_order,
    read_foreign,
    write_foreign,
)
from flexgs_edge.pipeline.geometry import read_geometry
from flexgs_edge.pipeline.judge import Judge, measurement_of
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.prune import Choice, nonzero_sh, ranks_from_order, select_rows
from flexgs_edge.render import Renderer
from flexgs_edge.scene import Planes, Rows, SceneSource, check_writable, sh_rest_count

LOG = logging.getLogger("flexgs_edge")

SH_A_PRUNE = {".spz": 0.5, ".sog": 1.5}
"""SH rate for each unit of the prune rate, by the bytes that SH take (5.5 of 22, and 27 of 40): loss rises 2 to 3 times as fast
with the prune rate as with the SH rate, and slowly at first with either. Where only the scene's degree counts there is none."""
FORMAT_BITS = ("bits", "groups")
"""Options that say what the format itself has settled."""


@dataclass(frozen=True)
class WrittenFile:
    """A finished file and what it decodes to.

    Parameters
    ----------
    path : Path
    size : int
        Bytes.
    count, sh_count : int
        Gaussians, and of these with SH as they went in (codebooks of `.sog` have no exact zero).
    sh_degree : int
    measurement : Measurement or None
        Quality of the decoded file (`None` without views).
    """

    path: Path
    size: int
    count: int
    sh_count: int
    sh_degree: int
    measurement: Measurement | None


def foreign_format(output: str | Path | None, options: CompressOptions) -> Format | None:
    """The format that `-o` asks for, checked against the options before any work; None for `.fgs`."""
    format = None if output is None else format_of(output)
    if format is None:
        return None
    for name in FORMAT_BITS:
        if getattr(options, name) != CompressOptions.__dataclass_fields__[name].default:
            raise InputError(f"--{name}: {format.suffix} has precisions of its own; leave it out, or write a .fgs")
    if options.distil or options.effort == "max":
        word = f"--distil {options.distil}" if options.distil else "--effort max"
        raise InputError(
            f"{word}: distilling ends on the grid of a .fgs, {format.suffix} has its own; leave it out, or write a .fgs"
        )
    if options.layers > 1:
        raise InputError(f"--layers {options.layers}: {format.suffix} has no layers; leave it out, or write a .fgs")
    assert output is not None
    check_converter(output)
    return format


@contextmanager
def open_files(
    format: Format,
    output: Path | None,
    force: bool,
    budget: MemoryBudget,
    renderer: Renderer | None,
    judge: Judge | None,
) -> Iterator[FileMaker]:
    """A folder for files beside `output` (in a dry run: where TMPDIR says), gone when the block ends."""
    beside = None if output is None else check_writable(output, force).parent
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=beside) as folder:
        yield FileMaker(format, Path(folder), budget, renderer, judge)


class FileMaker:
    """Writes candidates, reads them back and measures them.

    Parameters
    ----------
    folder : Path
        For the files.
    renderer, judge : Renderer, Judge or None
        `None`: nothing is measured.
    """

    def __init__(
        self, format: Format, folder: Path, budget: MemoryBudget, renderer: Renderer | None, judge: Judge | None
    ) -> None:
        self.format, self.folder = format, folder
        self._budget, self._renderer, self._judge = budget, renderer, judge
        self._made = 0

    def make(self, source: SceneSource) -> WrittenFile:
        """The file of `source`, measured on what it decodes to."""
        path, found = self.write(source)
        measurement = None
        if self._renderer is not None and self._judge is not None:
            with self._renderer.load(found) as scene:
                measurement = measurement_of(self._judge.compare(scene))
        sh_count = int(np.count_nonzero(nonzero_sh(source))) if found.sh_degree else 0
        return WrittenFile(path, path.stat().st_size, found.count, sh_count, found.sh_degree, measurement)

    def write(self, source: SceneSource) -> tuple[Path, SceneSource]:
        """A new file of `source`, and what it decodes to."""
        self._made += 1
        path = self.folder / f"{self._made}{self.format.suffix}"
        with self._converting(source.count):
            write_foreign(path, source)
            return path, read_foreign(path)

    def geometry(self, source: SceneSource) -> tuple[SceneSource, np.ndarray]:
        """See `flexgs_edge.pipeline.geometry.read_geometry`."""
        with self._converting(source.count):
            return read_geometry(self.folder, source, self.format)

    @contextmanager
    def _converting(self, count: int) -> Iterator[None]:
        """The converter's memory, taken while the block lasts."""
        size = converter_bytes(self.format, count)
        self._budget.take("the converter", size)
        try:
            yield
        finally:
            self._budget.give(size)


def publish(file: WrittenFile, output: Path, force: bool) -> None:
    """Give a file its name."""
    os.replace(file.path, check_writable(output, force))


def search_pruned_files(
    files: FileMaker,
    source: SceneSource,
    order: np.ndarray,
    target: Target | None,
    options: CompressOptions,
    on_step: Callable[[Step], None] | None = None,
) -> tuple[WrittenFile, SearchResult]:
    """The file that meets a target by pruning in rank order, along one line (or one for each SH degree).

    Parameters
    ----------
    source : SceneSource
        The original.
    order : np.ndarray
        [N] i64, least important row first.
    target : Target or None
        `None` for fixed rates.

    Raises
    ------
    TargetError
        When nothing holds and `best_effort` is not set.
    """
    search = _PrunedFiles(files, source, order, target, on_step)
    if options.fixed is not None:
        search.measure(options.fixed, source.sh_degree, "fixed")
    elif files.format.one_degree and source.sh_degree:
        search.by_degrees(LINE_STEPS[options.effort])
    else:
        search.line(source.sh_degree, LINE_STEPS[options.effort])
    assert search.best is not None
    chosen, file = search.best
    if target is not None and not chosen.holds and not options.best_effort:
        raise out_of_reach(target, chosen)
    return file, SearchResult(chosen, chosen.holds, tuple(search.steps))


class _PrunedFiles:
    """Files of a scene pruned by rank; the best so far stays, the others go."""

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
        self.steps: list[Step] = []
        self.best: tuple[Step, WrittenFile] | None = None

    def measure(self, choice: Choice, degree: int, phase: Phase = "line") -> Step:
        """Write, read back and measure the file of a choice, with SH up to `degree`."""
        started = time.perf_counter()
        with_sh, without = select_rows(self.ranks, choice, self.has_sh)
        keeps_sh = np.zeros(self.source.count, bool)
        keeps_sh[with_sh] = True
        rows = np.sort(np.concatenate([with_sh, without]))
        # Along a curve bytes repeat: 4 to 7 % of .spz.
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
        """A line for each SH degree that may give the answer: few rows with many SH, or many rows with few."""
        assert self.target is not None
        top = self.source.sh_degree
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
        # A degree more takes more bytes a row: it can only win if it holds at the prune rate of equal bytes.
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


class TrimmedSource(SceneSource):
    """A scene with SH up to a lower degree, and without SH where `keeps_sh` ([N] bool) is false."""

    def __init__(self, parent: SceneSource, keeps_sh: np.ndarray, degree: int) -> None:
        self.parent, self.keeps_sh = parent, keeps_sh
        self.name, self.origin, self.notes, self.count = parent.name, parent.origin, parent.notes, parent.count
        self.sh_degree = min(degree, parent.sh_degree)
        self.sh_count = self.count if self.sh_degree else 0

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self.parent.read(rows, [name for name in fields if name != "sh_rest"], planes)
        if "sh_rest" in planes and self.sh_degree:
            whole = self.parent.read(rows, ["sh_rest"])["sh_rest"] * self.keeps_sh[rows]
            planes["sh_rest"][...] = lower_degree(whole, self.sh_degree)
        return planes


def lower_degree(sh_rest: np.ndarray, degree: int) -> np.ndarray:
    """[3 K', n] SH up to `degree` from [3 K, n]: both channel by channel.

    >>> lower_degree(np.arange(24.0).reshape(24, 1), 1).ravel().tolist()
    [0.0, 1.0, 2.0, 8.0, 9.0, 10.0, 16.0, 17.0, 18.0]
    """
    channels = sh_rest.reshape(3, sh_rest.shape[0] // 3, -1)[:, : sh_rest_count(degree)]
    return np.ascontiguousarray(channels.reshape(-1, sh_rest.shape[1]))
