"""Read back the geometry that a format makes of a scene, so that colours can be refitted to it before the file is written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.io.exchange import read_foreign, write_foreign, written_order
from flexgs_edge.io.formats import Format
from flexgs_edge.scene.source import Planes, Rows, SceneSource


def read_geometry(folder: Path, source: SceneSource, format: Format) -> tuple[SceneSource, np.ndarray]:
    """Write a scene without SH in a format and read it back: the geometry that `write_foreign` would give.

    Positions, scales, rotations and opacities are the same as with SH.

    Returns a source of SH degree 0, and [N] i64: the row of `source` behind each row.
    """
    path = folder / f"geometry{format.suffix}"
    write_foreign(path, _WithoutSh(source), force=True)
    try:
        return read_foreign(path), written_order(source)
    finally:
        path.unlink()


class _WithoutSh(SceneSource):
    """A scene without SH above degree 0."""

    def __init__(self, parent: SceneSource) -> None:
        self.parent, self.name, self.origin, self.notes = parent, parent.name, parent.origin, parent.notes
        self.count, self.sh_degree, self.sh_count = parent.count, 0, 0
        self.settings, self.held_bytes, self.valid = parent.settings, parent.held_bytes, parent.valid

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        return self.parent.read(rows, [name for name in fields if name != "sh_rest"], planes) | planes
