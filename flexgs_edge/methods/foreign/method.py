"""Compression into formats of other programs: every step writes a file, reads it back and measures it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.goals.target import Target
from flexgs_edge.io.exchange import near_order, read_foreign
from flexgs_edge.io.formats import Format
from flexgs_edge.methods.best.allocation import BitModel, choose, choose_one_degree
from flexgs_edge.methods.best.effort import EFFORTS, Effort
from flexgs_edge.methods.best.memory_plan import expected_bytes as expected_bytes
from flexgs_edge.methods.best.method import MakerOf, See, choose_poses, search_best
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.rounds import PruneRounds, take_rows
from flexgs_edge.methods.best.search import Candidate
from flexgs_edge.methods.best.selection import PRUNED_PART, Guess, Measure, Selection
from flexgs_edge.methods.foreign.file_maker import FileMaker, WrittenFile, open_files, publish
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.lower_sh import lower_degree
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.units import format_size
from flexgs_edge.views.render_context import RenderContext

LOG = logging.getLogger("flexgs_edge")


class CostMaker:
    """Makes files of a format by measured costs; a `Maker`.

    `refit`: refit colours to the decoded geometry, and their constant to the decoded SH (default). This writes two more
    files for each candidate.
    """

    def __init__(
        self,
        rounds: PruneRounds,  # rounds of pruning; more are done when they are needed
        files: FileMaker,  # writes, reads back and measures
        measure: Measure,  # quality of planes without quantization
        effort: Effort,  # how much work to spend
        refit: bool = True,
        see: See | None = None,  # as for `GridMaker`
    ) -> None:
        self.rounds, self.files, self.measure = rounds, files, measure
        self.effort, self.refit, self.close = effort, refit, effort.close
        chosen = choose_one_degree if files.format.one_degree else choose
        bits = bit_model(files.format, len(rounds.snapshots[0].costs.sh))
        self.selection = Selection(rounds, effort.keep, chosen, bits)
        self._see = see

    def start(self, target: Target) -> float:
        """See `Maker`."""
        Guess(self.measure).prune(self.selection, target, PRUNED_PART)
        return self.selection.cut()

    def probe(self, multiplier: float, target: Target) -> float | None:
        """See `Maker`: only a written file tells."""
        return None

    def make(self, multiplier: float, target: Target) -> tuple[Candidate, WrittenFile]:
        """See `Maker`."""
        started = time.perf_counter()
        kept = self.selection.kept(multiplier)
        planes, degrees = kept.planes, kept.degrees
        planes["sh_rest"] = lower_degree(planes["sh_rest"], int(degrees.max(initial=0)))
        order = near_order(MemorySource(planes, origin=self.rounds.original.origin))
        file = self._finish(take_rows(planes, order), degrees[order])
        assert file.measurement is not None
        excess = target.excess(file.size, file.measurement)
        seconds = time.perf_counter() - started
        return Candidate(multiplier, file.count, file.sh_count, file.size, file.measurement, excess, seconds), file

    def trim(
        self, chosen: Candidate, product: WrittenFile, target: Target, tell: Callable[[Candidate], None], most: int
    ) -> tuple[Candidate, WrittenFile]:
        """See `Maker`: a file stays as it is."""
        return chosen, product

    def see(self, views: Sequence[int]) -> bool:
        """See `Maker`."""
        return self._see is not None and self._see(views, self.selection.begin)

    def discard(self, product: WrittenFile) -> None:
        """Remove a file that is not the best any more."""
        product.path.unlink()

    def _finish(self, planes: dict[str, np.ndarray], degrees: np.ndarray) -> WrittenFile:
        """Refit all colours to the decoded geometry, then the constant to the decoded SH. Geometry is written as it was."""
        original = self.rounds.original
        source = MemorySource(planes, origin=original.origin)
        if not self.refit:
            return self.files.make(source)
        found, rows = self.files.geometry(source)
        shared = degrees[rows], replace(original, origin=found.origin)
        subsets = self.effort.subsets_of(len(original.cameras))
        geometry = found.read(slice(0, found.count), list(FIELD))
        colours = {name: np.ascontiguousarray(planes[name][:, rows]) for name in ("sh_dc", "sh_rest")}
        moved = refit_colours({**geometry, **colours}, *shared, rounds=self.effort.refit_rounds, subsets=subsets)
        planes = {**planes, "sh_dc": _put(moved["sh_dc"], rows), "sh_rest": _put(moved["sh_rest"], rows)}
        if len(planes["sh_rest"]):
            place, coded = self.files.write(MemorySource(planes, origin=original.origin))
            decoded = coded.read(slice(0, coded.count), list(FIELD))
            place.unlink()
            refitted = refit_colours(
                {**decoded, "sh_dc": moved["sh_dc"]}, *shared, rounds=1, bands=False, subsets=subsets
            )
            planes["sh_dc"] = _put(refitted["sh_dc"], rows)
        return self.files.make(MemorySource(planes, origin=original.origin))


def _put(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`values` with column i moved to column `rows[i]`."""
    placed = np.empty_like(values)
    placed[:, rows] = values
    return placed


def bit_model(format: Format, sh_degree: int) -> BitModel:
    """Bits of a Gaussian in a format; those of SH are shared equally among their coefficients.

    Degrees that the format does not hold take infinitely many bits.
    """
    each = 8 * format.sh_bytes / sh_rest_count(3)
    degrees = range(1, sh_degree + 1)
    bands = tuple((2 * level + 1) * each if level <= format.max_degree else np.inf for level in degrees)
    return BitModel(8 * (format.row_bytes - format.sh_bytes), bands)


def file_maker(options: CompressOptions, files: FileMaker) -> MakerOf[WrittenFile]:
    """Make makers of a file of another program's format."""

    def make(rounds: PruneRounds, measure: Measure, see: See | None = None) -> CostMaker:
        maker = CostMaker(rounds, files, measure, EFFORTS[options.effort], options.refit, see)
        maker.selection.most = options.max_gaussians
        return maker

    return make


def compress(run: Run[CompressOptions], context: RenderContext | None) -> MethodResult:
    """Compress a scene into a file of another program's format, by measured costs.

    `run`: planned. `context`: draws the views.
    """
    options, plan, output, format = run.options, run.plan, run.output.path, run.output.format
    # The plan has refused runs without views.
    assert context is not None and plan is not None and plan.target is not None and format is not None
    with Evaluators(run, context) as judges:
        judges.prepare()
        if options.antialiased and not format.marks_antialiased:
            LOG.warning("%s does not say that the model is antialiased: viewers must be told", format.suffix)
        poses = choose_poses(run, context, judges.decide)
        with open_files(run, format, context, judges) as files:
            LOG.info("searching for %s", plan.target.describe())
            file, search = search_best(file_maker(options, files), run, context, poses, judges.decide)
            judges.decided()
            quality = judges.measure(read_foreign(file.path))
            if output is not None:
                publish(file, output, options.force)
                LOG.info("wrote %s, %s", output, format_size(file.size))
        return MethodResult(
            size=file.size,
            count=file.count,
            sh_count=file.sh_count,
            sh_degree=file.sh_degree,
            choice=search.chosen.choice,
            search=search,
            quality=quality,
            trained=judges.trained,
        )
