"""Writes candidate files of other formats, reads them back and measures them.

Other programs define these bytes, so only a written file tells its size and quality.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.files import check_writable
from flexgs_edge.goals.target import Measurement
from flexgs_edge.io.exchange import read_foreign, write_foreign, written_order
from flexgs_edge.io.formats import Format
from flexgs_edge.io.reading import PLAIN, Writing
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.paper.prune import nonzero_sh
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.evaluators import Evaluators
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator, measurement_of
from flexgs_edge.run.run import Run
from flexgs_edge.scene.lower_sh import TrimmedSource
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.views.render_context import RenderContext

LOG = logging.getLogger("flexgs_edge")


def read_geometry(folder: Path, source: SceneSource, format: Format) -> tuple[SceneSource, np.ndarray]:
    """Write a scene without SH in a format and read it back: the geometry that `write_foreign` would give.

    Positions, scales, rotations and opacities are the same as with SH.

    Returns a source of SH degree 0, and [N] i64: the row of `source` behind each row.
    """
    path = folder / f"geometry{format.suffix}"
    write_foreign(path, TrimmedSource(source, np.ones(0, bool), 0), force=True)
    try:
        return read_foreign(path), written_order(source)
    finally:
        path.unlink()


@dataclass(frozen=True)
class WrittenFile:
    """A finished file, and the size and quality of the scene that it decodes to."""

    path: Path  # where it lies
    size: int  # bytes
    count: int  # Gaussians
    # Gaussians that had SH when they were written. (After decoding nobody knows: codebooks of `.sog` have no exact
    # zero.).
    sh_count: int
    sh_degree: int  # SH degree of the decoded scene
    measurement: Measurement | None  # quality of the decoded file (`None` without views)


@contextmanager
def open_files(
    run: Run[CompressOptions], format: Format, context: RenderContext | None = None, judges: Evaluators | None = None
) -> Iterator[FileMaker]:
    """A `FileMaker` with a folder beside `output` (in a dry run: in TMPDIR), which is removed when the block ends."""
    output = run.output.path
    beside = None if output is None else check_writable(output, run.options.force).parent
    renderer, judge = None if context is None else context.renderer, None if judges is None else judges.decide
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=beside) as folder:
        yield FileMaker(format, Path(folder), run.budget, renderer, judge, run.options.writing)


class FileMaker:
    """Writes candidates, reads them back and measures them.

    `renderer`, `judge`: `None`: nothing is measured.
    """

    def __init__(
        self,
        format: Format,  # what to write
        folder: Path,  # for the files
        budget: MemoryBudget,  # the memory that writing and reading back take is taken from it
        renderer: Renderer | None,
        judge: QualityEvaluator | None,
        writing: Writing = PLAIN,  # what the user says about the format
    ) -> None:
        self.format, self.folder, self.writing = format, folder, writing
        self._budget, self._renderer, self._judge = budget, renderer, judge
        self._made = 0

    def make(self, source: SceneSource) -> WrittenFile:
        """Write the file of `source` and measure the scene that it decodes to."""
        path, found = self.write(source)
        measurement = None
        if self._renderer is not None and self._judge is not None:
            with self._renderer.load(found) as scene:
                measurement = measurement_of(self._judge.compare(scene, with_ssim=True))
        sh_count = int(np.count_nonzero(nonzero_sh(source))) if found.sh_degree else 0
        return WrittenFile(path, path.stat().st_size, found.count, sh_count, found.sh_degree, measurement)

    def write(self, source: SceneSource) -> tuple[Path, SceneSource]:
        """Write a new file of `source`; returns its path and the decoded scene."""
        self._made += 1
        path = self.folder / f"{self._made}{self.format.suffix}"
        with self._converting(source.count):
            write_foreign(path, source, writing=self.writing)
            return path, read_foreign(path)

    def geometry(self, source: SceneSource) -> tuple[SceneSource, np.ndarray]:
        """See `flexgs_edge.methods.foreign.file_maker.read_geometry`."""
        with self._converting(source.count):
            return read_geometry(self.folder, source, self.format)

    @contextmanager
    def _converting(self, count: int) -> Iterator[None]:
        """Take the memory of writing and reading back from the budget while the block lasts."""
        size = self.format.memory * count
        self._budget.take(f"writing a {self.format.suffix}", size)
        try:
            yield
        finally:
            self._budget.give(size)


def publish(file: WrittenFile, output: Path, force: bool) -> None:
    """Move a finished file to `output`."""
    os.replace(file.path, check_writable(output, force))
