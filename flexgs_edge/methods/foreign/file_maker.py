"""Writes grids as files of other formats, and reads them back: only a file of another program's format tells its size."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.files import check_writable
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import values_of
from flexgs_edge.io.exchange import read_foreign, write_foreign
from flexgs_edge.io.formats import Format
from flexgs_edge.io.reading import PLAIN, Writing
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, Planes, SceneSource


@contextmanager
def open_files(run: Run[CompressOptions], format: Format) -> Iterator[FileMaker]:
    """A `FileMaker` with a folder beside `output` (in a dry run: in TMPDIR), which is removed when the block ends."""
    output = run.output.path
    beside = None if output is None else check_writable(output, run.options.force).parent
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=beside) as folder:
        yield FileMaker(format, Path(folder), run.budget, run.options.writing)


class FileMaker:
    """Writes one file at a time; the last one stays until the next is asked for."""

    def __init__(
        self,
        format: Format,
        folder: Path,  # for the file
        budget: MemoryBudget,  # pays for writing and reading back
        writing: Writing = PLAIN,  # what the user says about the format
    ) -> None:
        self.format, self.writing = format, writing
        self._path, self._budget = folder / f"scene{format.suffix}", budget
        self._grid: GridScene | None = None

    def write(self, source: SceneSource) -> tuple[Path, SceneSource]:
        """Write the file of a scene; returns its path and the decoded scene."""
        self._write(source, self.writing)
        return self._path, read_foreign(self._path)

    def of(self, grid: GridScene) -> Path:
        """The file of a grid. Positions of the whole scene are checked before the search, and not once more here."""
        if grid is not self._grid:
            self._grid = None
            self._write(MemorySource(values_of(grid), origin=grid.origin), replace(self.writing, force_lossy=True))
            self._grid = grid
        return self._path

    def _write(self, source: SceneSource, writing: Writing) -> None:
        """Write a file; writing and reading back may take `Format.memory` for each row."""
        size = self.format.memory * source.count
        self._budget.take(f"writing a {self.format.suffix}", size)
        try:
            write_foreign(self._path, source, force=True, writing=writing)
        finally:
            self._budget.give(size)

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


def publish(file: Path, output: Path, force: bool) -> None:
    """Move a finished file to `output`."""
    os.replace(file, check_writable(output, force))
