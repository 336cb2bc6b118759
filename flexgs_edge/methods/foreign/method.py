"""Compression into formats of other programs: the search of `best`, whose candidates are written as files and read back.

Pruning, fine-tuning and the grid are those of a `.fgs`, since values on a grid also pack well elsewhere. Size and quality are
those of the file.
"""

import os
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.files import check_writable
from flexgs_edge.grid.grid_scene import GridScene, values_of
from flexgs_edge.io.exchange import read_foreign, write_foreign
from flexgs_edge.io.formats import Format
from flexgs_edge.methods.best.allocation import BitModel, Measure, OneDegree, choose
from flexgs_edge.methods.best.effort import effort_of
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.memory_plan import expected_bytes as expected_bytes
from flexgs_edge.methods.best.method import MakerOf, See, choose_poses, search_best
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.progress import LOG
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.method_result import MethodResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, Planes
from flexgs_edge.units import format_size


def compress(run: Run[CompressOptions], renderer: Renderer | None) -> MethodResult:
    """Compress a scene into a file of another program's format. `run`: planned. `renderer`: draws the views."""
    options, plan, output, format = run.options, run.plan, run.output.path, run.output.format
    # The plan has refused runs without views.
    assert renderer is not None and plan is not None and plan.target is not None and format is not None
    with Evaluators(run, renderer) as judges:
        judges.prepare()
        if options.antialiased and not format.marks_antialiased:
            LOG.warning("%s does not say that the model is antialiased: viewers must be told", format.suffix)
        poses = choose_poses(run, renderer, judges.decide)
        beside = None if output is None else check_writable(output, options.force).parent
        with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=beside) as folder:
            files = Files(run, format, Path(folder))
            LOG.info("searching for %s", plan.target.describe())
            grid, search = search_best(file_maker(run, files), run, renderer, poses, judges.decide)
            judges.decided()
            file = files.of(grid)
            source = read_foreign(file)
            quality, size = judges.measure(source), file.stat().st_size
            if output is not None:
                os.replace(file, check_writable(output, options.force))
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
            lost=judges.lost,
        )


class Files:
    """Writes one file of another program's format at a time; the last one stays until the next is asked for.

    `folder`: for the file.
    """

    def __init__(self, run: Run[CompressOptions], format: Format, folder: Path) -> None:
        # Positions of the whole scene are checked before the search, and not once more here.
        self.format, self._writing = format, replace(run.options.writing, force_lossy=True)
        self._path, self._budget = folder / f"scene{format.suffix}", run.budget
        self._grid: GridScene | None = None

    def of(self, grid: GridScene) -> Path:
        """The file of a grid."""
        if grid is not self._grid:
            self._grid = None
            size = self.format.memory * grid.count
            self._budget.take(f"writing a {self.format.suffix}", size)
            try:
                source = MemorySource(values_of(grid), origin=grid.origin)
                write_foreign(self._path, source, force=True, writing=self._writing)
            finally:
                self._budget.give(size)
            self._grid = grid
        return self._path

    def size_of(self, grid: GridScene) -> int:
        """Bytes of the file of a grid."""
        return self.of(grid).stat().st_size

    def decoded(self, grid: GridScene, origin: np.ndarray) -> Planes:
        """What the file of a grid holds, as planes relative to `origin`."""
        source = read_foreign(self.of(grid))
        planes = source.read(slice(0, source.count), list(FIELD))
        if np.any(source.origin != origin):
            planes["means"] = (planes["means"] + (source.origin - origin)[:, None]).astype(np.float32)
        return planes


def file_maker(run: Run[CompressOptions], files: Files) -> MakerOf[GridScene]:
    """Make makers of grids that are written as files of another program's format."""

    def make(rounds: PruneRounds, measure: Measure, see: See | None = None) -> GridMaker:
        origin = rounds.original.origin
        maker = GridMaker(
            rounds,
            files.size_of,
            measure,
            effort_of(run),
            run.options.refit,
            rounds.original.steps,
            see,
            lambda grid: files.decoded(grid, origin),
            OneDegree() if files.format.fixed_rows else choose,
            bit_model(files.format),
            files.format.fixed_rows,
            files.format.most_colour,
        )
        maker.selection.most = run.options.max_gaussians
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
