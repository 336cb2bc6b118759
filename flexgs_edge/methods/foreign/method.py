"""Compression into formats of other programs: the search of `best`, whose candidates are written as files and read back.

Pruning, fine-tuning and the grid are those of a `.fgs`, since values on a grid also pack well elsewhere. Size and quality are
those of the file.
"""

from __future__ import annotations

import logging

import numpy as np

from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.formats import Format
from flexgs_edge.methods.best.allocation import BitModel, OneDegree, choose
from flexgs_edge.methods.best.effort import effort_of
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.memory_plan import expected_bytes as expected_bytes
from flexgs_edge.methods.best.method import MakerOf, See, choose_poses, search_best
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.selection import Measure
from flexgs_edge.methods.foreign.file_maker import FileMaker, open_files, publish
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.units import format_size
from flexgs_edge.views.render_context import RenderContext

LOG = logging.getLogger("flexgs_edge")


def compress(run: Run[CompressOptions], context: RenderContext | None) -> MethodResult:
    """Compress a scene into a file of another program's format.

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
        with open_files(run, format) as files:
            LOG.info("searching for %s", plan.target.describe())
            grid, search = search_best(file_maker(options, files), run, context, poses, judges.decide)
            judges.decided()
            file = files.of(grid)
            source = read_foreign(file)
            quality, size = judges.measure(source), file.stat().st_size
            if output is not None:
                publish(file, output, options.force)
                LOG.info("wrote %s, %s", output, format_size(size))
        return MethodResult(
            size=size,
            count=grid.count,
            sh_count=grid.sh_count if source.sh_degree else 0,
            sh_degree=source.sh_degree,
            choice=search.chosen.choice,
            search=search,
            quality=quality,
            trained=judges.trained,
        )


def file_maker(options: CompressOptions, files: FileMaker) -> MakerOf[GridScene]:
    """Make makers of grids that are written as files of another program's format."""

    def make(rounds: PruneRounds, measure: Measure, see: See | None = None) -> GridMaker:
        origin = rounds.original.origin
        maker = GridMaker(
            rounds,
            files.size_of,
            measure,
            effort_of(options),
            options.refit,
            rounds.original.steps,
            see,
            lambda grid: files.decoded(grid, origin),
            OneDegree() if files.format.fixed_rows else choose,
            bit_model(files.format),
            files.format.fixed_rows,
            files.format.most_colour,
        )
        maker.selection.most = options.max_gaussians
        return maker

    return make


def bit_model(format: Format) -> BitModel:
    """Bits of a Gaussian: those of a `.fgs` where values are packed, else the share of each SH degree in a row.

    SH degrees that the format does not hold take infinitely many bits.
    """
    plain = BitModel()
    bands = plain.bands
    if format.fixed_rows:
        each = plain.base * format.sh_bytes / (format.row_bytes - format.sh_bytes) / sh_rest_count(3)
        bands = tuple((2 * level + 1) * each for level in range(1, len(bands) + 1))
    return BitModel(bands=tuple(bits if at < format.max_degree else np.inf for at, bits in enumerate(bands)))
