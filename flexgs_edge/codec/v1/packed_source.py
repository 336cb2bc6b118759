"""Read a version 1 file as a scene source."""

import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from flexgs_edge.codec.v1.container import CHUNK_ROWS, Container
from flexgs_edge.packed.bitpack import plane_bytes
from flexgs_edge.packed.quantize import QuantizedArray, QuantizedScene, dequantize
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import Planes, Rows, SceneSource, by_chunk


class FgsSource(SceneSource):
    """A version 1 file as a scene. Memory holds the ranges and the last chunk; a chunk is read and checked when needed.

    `path`: the file. `settings`: how the file was made. Raises `FormatError` if the file differs from the format; a
    damaged chunk raises it when it is read.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.container = Container(path)
        header = self.container.header
        self.name, self.notes = str(path), ()
        self.count, self.sh_degree, self.sh_count = header.count, header.sh_degree, header.sh_count
        self.origin, self.contraction = np.array(header.origin, np.float64), header.contraction
        self.settings: dict[str, Any] = header.settings
        self._ranges = self.container.read_ranges()
        self._table = self.container.read_chunk_table()
        self._last: tuple[int, dict[str, QuantizedArray]] | None = None

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`. A chunk is dequantized from the first to the last of its rows, also if they are sparse."""
        rows, planes = self.begin_read(rows, fields, out)
        for chunk, wanted, place in by_chunk(rows, np.arange(0, self.count, CHUNK_ROWS)):
            first, arrays = self._chunk(chunk)
            for field, plane in planes.items():
                _fill(arrays[field], first, wanted, plane[:, place])
                if field == "means" and self.contraction is not None:
                    plane[:, place] = self.contraction.expand(plane[:, place])
        return planes

    def quantized(self) -> QuantizedScene:
        """The codes and ranges of the whole scene; this reads and checks every chunk of the file."""
        header = self.container.header
        arrays = {
            field.name: self._array(
                field.name,
                np.empty(
                    (self.width(field.name), plane_bytes(header.rows(field.name), header.bits.of(field.name))), np.uint8
                ),
            )
            for field in FIELDS
        }
        for chunk, entry in enumerate(self._table):
            for name, part in self._cut(chunk, self.container.read_chunk(entry)).items():
                start = chunk * (CHUNK_ROWS // 8) * part.bits
                arrays[name].planes[:, start : start + part.planes.shape[1]] = part.planes
        return QuantizedScene(self.count, self.sh_count, self.sh_degree, self.origin, arrays, self.contraction)

    def _chunk(self, chunk: int) -> tuple[int, dict[str, QuantizedArray]]:
        """The arrays with the rows of a chunk, and the row at which their planes start."""
        if self._last is None or self._last[0] != chunk:
            self._last = None  # freed before the next chunk is read, so that memory holds one chunk
            self._last = (chunk, self._cut(chunk, self.container.read_chunk(self._table[chunk])))
        return chunk * CHUNK_ROWS, self._last[1]

    def _cut(self, chunk: int, data: bytes) -> dict[str, QuantizedArray]:
        """Split the bytes of a chunk into its six arrays (views, not copies)."""
        header = self.container.header
        packed = np.frombuffer(data, np.uint8)
        arrays = {}
        at = 0
        for field in FIELDS:
            rows, channels = header.chunk_rows(chunk, field.name), self.width(field.name)
            length = plane_bytes(rows, header.bits.of(field.name))
            planes = packed[at : at + channels * length].reshape(channels, length)
            arrays[field.name] = self._array(field.name, planes)
            at += channels * length
        return arrays

    def _array(self, field: str, planes: np.ndarray) -> QuantizedArray:
        header = self.container.header
        low, step = self._ranges[field]
        return QuantizedArray(header.bits.of(field), header.rows(field), self.width(field), low, step, planes)


def _fill(array: QuantizedArray, first: int, rows: Rows, out: np.ndarray) -> None:
    """Dequantize `rows` into `out` [c, n]; rows beyond the array (rows without SH) become zero."""
    if isinstance(rows, slice):
        here = slice(min(rows.start, array.count), min(rows.stop, array.count))
        dequantize(array, here, first, out[:, : here.stop - here.start])
        out[:, here.stop - here.start :] = 0
        return
    inside = rows < array.count
    out[:, ~inside] = 0
    if inside.any():
        chosen = rows[inside]
        start = int(chosen.min())
        out[:, inside] = dequantize(array, slice(start, int(chosen.max()) + 1), first)[:, chosen - start]
