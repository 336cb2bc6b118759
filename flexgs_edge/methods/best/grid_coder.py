"""Codes the grids of a search with the real coder, so that their sizes are exact."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexgs_edge.codec.v2.container import coded_size, write_grid
from flexgs_edge.codec.v2.encode import Encoded, encode_grid
from flexgs_edge.codec.v2.header import PREVIEW_KEY
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.methods.best.allocation import BitModel
from flexgs_edge.methods.best.preview import default_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.decoding import coding_device
from flexgs_edge.run.options import CompressOptions


def projected_size(options: CompressOptions, size: int) -> int:
    """Bytes that a file of `size` bytes will have with its layers and the preview that was asked for, or that it gets by default.

    Layers cost at most 6 %, since neighbours on the curve are farther apart in a layered file:
    docs/results/tuning.md#layers_cost
    """
    cost = 1.0 if options.layers in (None, 1) else 1.06
    return round(cost * size) + with_preview(default_bytes(size) if options.preview is None else options.preview)


def with_preview(size: int) -> int:
    """Most bytes by which a preview of `size` bytes makes a file longer; 0 if there is none."""
    return size + PREVIEW_KEY if size else 0


class GridCoder:
    """Codes grids. The last one stays coded, so that writing it only copies bytes.

    `renderer`: its device codes if it can. `settings_room`: most bytes of the settings in the header. The search counts
    them before they are known.
    """

    def __init__(self, renderer: Renderer, settings_room: int) -> None:
        self._renderer, self._settings_room = renderer, settings_room
        self._last: tuple[GridScene, Encoded] | None = None

    def _encode(self, grid: GridScene) -> Encoded:
        self._trim()
        device = coding_device(self._renderer.backend, self._renderer.budget, grid.count, grid.sh_degree)
        return encode_grid(grid, device=device, storage=self._renderer.storage)

    def encoded(self, grid: GridScene) -> Encoded:
        """The coded grid."""
        if self._last is None or self._last[0] is not grid:
            self._last = None
            encoded = self._encode(grid)
            # If a scene needs scratch files, even the bytes of its file may be too many for memory.
            self._last = grid, encoded if self._renderer.storage.spills else encoded.finished()
        return self._last[1]

    def bits(self, grid: GridScene) -> BitModel:
        """Bits of its Gaussians. No stream is written for this."""
        known = self._last is not None and self._last[0] is grid
        return bit_model(grid, self.encoded(grid) if known else self._encode(grid))

    def size(self, grid: GridScene, settings: Mapping[str, Any] | None = None, preview: bytes = b"") -> int:
        """Bytes of the file that `write` makes. A search does not know the `settings` yet: without them it is an upper bound."""
        encoded = self.encoded(grid)
        self._trim()
        size = coded_size(grid, settings or {}, encoded=encoded, preview=preview)
        return size + self._settings_room if settings is None else size

    def write(
        self, path: str | os.PathLike[str], grid: GridScene, settings: Mapping[str, Any], preview: bytes = b""
    ) -> int:
        """See `write_grid`."""
        encoded = self.encoded(grid)
        self._trim()
        return write_grid(path, grid, settings, encoded=encoded, preview=preview)

    def _trim(self) -> None:
        """Return the holes that drawing and counting left in the heap, where memory is short."""
        if self._renderer.storage.spills:
            trim_heap()


def bit_model(grid: GridScene, encoded: Encoded) -> BitModel:
    """Bits of the Gaussians of a coded grid.

    The information in the SH is shared among their coefficients; the rest among the rows.
    """
    sh = encoded.sh_bytes
    base = encoded.information - sh
    rows = [int(np.count_nonzero(grid.sh_degrees >= level)) for level in range(1, grid.sh_degree + 1)]
    values = sum((2 * level + 1) * count for level, count in enumerate(rows, start=1))
    each = 8 * sh / max(values, 1)
    return BitModel(
        8 * base / max(grid.count, 1), tuple((2 * level + 1) * each for level in range(1, grid.sh_degree + 1))
    )
