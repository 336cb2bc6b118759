"""Codes the grids of a search, and tells what they cost."""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexgs_edge.best.choice import BitModel
from flexgs_edge.codec.coder import Encoded, encode_grid
from flexgs_edge.codec.container2 import coded_parts, write_grid
from flexgs_edge.grid import GridScene
from flexgs_edge.pipeline.workspace import coding_device
from flexgs_edge.render import Renderer

SETTINGS_MOST = 1536
"""Bytes that the settings in the header take at most: the search counts them before they are known."""


class GridCoder:
    """Codes the grids of a search. The last one stays coded, so that writing it is copying.

    Parameters
    ----------
    renderer : Renderer
        Its device codes where it can.
    """

    def __init__(self, renderer: Renderer) -> None:
        self._renderer = renderer
        self._last: tuple[GridScene, Encoded] | None = None

    def encoded(self, grid: GridScene) -> Encoded:
        """The grid as it will lie in a file."""
        if self._last is None or self._last[0] is not grid:
            self._last = None
            device = coding_device(self._renderer.backend, self._renderer.budget, grid)
            encoded = encode_grid(grid, device=device, room=self._renderer.room)
            # Of a scene in scratch files even the bytes of the file may be too many.
            self._last = grid, encoded if self._renderer.room.spills else encoded.finished()
        return self._last[1]

    def size_and_bits(self, grid: GridScene) -> tuple[int, BitModel]:
        """See `size_and_bits`."""
        return size_and_bits(grid, self.encoded(grid))

    def size(self, grid: GridScene, settings: Mapping[str, Any]) -> int:
        """Bytes of the file that `write` makes."""
        return coded_parts(grid, settings, encoded=self.encoded(grid))[0]

    def write(self, path: str | os.PathLike[str], grid: GridScene, settings: Mapping[str, Any]) -> int:
        """See `write_grid`."""
        return write_grid(path, grid, settings, encoded=self.encoded(grid))


def size_and_bits(grid: GridScene, encoded: Encoded | None = None) -> tuple[int, BitModel]:
    """Exact bytes of a grid's file, and what its Gaussians cost.

    The bytes of the SH are shared among their coefficients; the rest among the rows.
    """
    size, sh = coded_parts(grid, {}, encoded=encoded)
    size += SETTINGS_MOST
    base = size - sh
    rows = [int(np.count_nonzero(grid.sh_degrees >= level)) for level in range(1, grid.sh_degree + 1)]
    values = sum((2 * level + 1) * count for level, count in enumerate(rows, start=1))
    each = 8 * sh / max(values, 1)
    return size, BitModel(
        8 * base / max(grid.count, 1), tuple((2 * level + 1) * each for level in range(1, grid.sh_degree + 1))
    )
