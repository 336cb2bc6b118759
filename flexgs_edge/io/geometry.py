"""Read back the geometry that a format makes of a scene, so that colours can be refitted to it before the file is written."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.io.converter import CONVERTER
from flexgs_edge.io.exchange import read_foreign, write_foreign, written_order
from flexgs_edge.io.formats import Format
from flexgs_edge.scene.source import Planes, Rows, SceneSource


def read_geometry(folder: Path, source: SceneSource, format: Format) -> tuple[SceneSource, np.ndarray]:
    """Write a scene without SH in a format and read it back: the geometry that `write_foreign` would give.

    Without SH, there is no clustering. Positions, scales, rotations and opacities are the same as with SH.

    Parameters
    ----------
    folder : Path
        For the temporary file.

    Returns
    -------
    tuple
        A source of SH degree 0, whose colours have no meaning, and [N] i64: the row of `source` behind each row.
    """
    path = folder / f"geometry{format.suffix}"
    write_foreign(path, _LabelSource(source), force=True)
    try:
        found = read_foreign(path)
        rows = written_order(source, format)
        if rows is not None:
            return found, rows
        colours = found.read(slice(0, found.count), ["sh_dc"])["sh_dc"].astype(np.float64)
        digits = np.rint(_LabelSource.decode(colours)).astype(np.int64)
        rows = digits[0] + 256 * digits[1] + 65536 * digits[2]
        if not np.array_equal(np.sort(rows), np.arange(source.count)):
            raise InputError(f"this version of {CONVERTER} does not keep colours in {format.suffix}; use --no-refit")
        return found, rows
    finally:
        path.unlink()


class _LabelSource(SceneSource):
    """A scene without SH whose colours spell the number of each row, in three digits of base 256.

    Formats with 8 bits, and with codebooks of 256 entries, keep these digits (`.sog` up to .03 of a digit).
    """

    def __init__(self, parent: SceneSource) -> None:
        if parent.count > 2**24:
            raise InputError(f"{parent.name}: more than 2^24 Gaussians; use --no-refit for this format")
        self.parent, self.name, self.origin, self.notes = parent, parent.name, parent.origin, parent.notes
        self.count, self.sh_degree, self.sh_count = parent.count, 0, 0

    @staticmethod
    def decode(colours: np.ndarray) -> np.ndarray:
        """Digits from colour coefficients: 8-bit formats cover 0 to 1 of (.15 c + .5)."""
        return (colours * 0.15 + 0.5) * 255

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        inner = [name for name in fields if name not in ("sh_dc", "sh_rest")]
        self.parent.read(rows, inner, planes)
        if "sh_dc" in planes:
            ids = np.arange(self.count)[rows]
            digits = np.stack([ids % 256, ids // 256 % 256, ids // 65536])
            planes["sh_dc"][...] = (digits / 255 - 0.5) / 0.15
        return planes
