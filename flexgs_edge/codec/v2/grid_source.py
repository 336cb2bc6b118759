"""Read a version 2 file as a scene; chunks are decoded when they are read, and the last one is kept."""

import json
import os
from collections.abc import Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np

from flexgs_edge.codec.sections import ChunkEntry
from flexgs_edge.codec.v2.container import GridContainer
from flexgs_edge.codec.v2.device.decode_kernel import ChunkKernel, RowSteps
from flexgs_edge.codec.v2.device.launch import Device
from flexgs_edge.codec.v2.header import Chunk
from flexgs_edge.codec.v2.threads import in_order, thread_count
from flexgs_edge.codec.v2.walk import ChunkCodes, base_kinds
from flexgs_edge.constants import CODE_LIMIT
from flexgs_edge.grid.grid_scene import CODES, GridScene, from_grid
from flexgs_edge.scene.check import SH_LARGEST
from flexgs_edge.scene.source import Planes, Rows, SceneSource, by_chunk

GRID_COMMENT = "flexgs-edge grid "  # Begins the comment in a PLY that names the step sizes of its values
DECODE_BYTES = 800  # Bound on the bytes per row while NumPy decodes a chunk: codes, features, neighbours' weights, sums
_ROTATION_STEP_MOST = 2.0**38
"""Bound up to which three squares of a rotation code (24 bits) times its step stay finite in float32."""


class GridSource(SceneSource):
    """A `.fgs` file of version 2 as a scene.

    `path`: the file. `container`: the file, if it is open, or its `Preview`. `settings`: how the file was made. Raises
    `FormatError` if the file differs from the format; a damaged chunk raises it when it is read.
    """

    def __init__(self, path: str | os.PathLike[str], container: GridContainer | None = None) -> None:
        self.container = container or GridContainer(path)
        header = self.container.header
        self.name, self.notes = str(path), ()
        self.count, self.sh_degree = header.count, header.sh_degree
        self.sh_count = self.count if self.sh_degree else 0
        self.origin = np.array(header.origin, np.float64)
        self.whole = None if header.cut_from is None else header.cut_from["count"]
        # A code times a step is finite. Only squares of absurd rotations and colours could leave float32, so the steps
        # tell enough. A check of the values would decode the file twice more.
        steps = header.grid_steps
        colour = CODE_LIMIT * max(steps.dc, *steps.sh, 0.0) * (1 + steps.chroma)
        self.valid = steps.rotation <= _ROTATION_STEP_MOST and colour <= SH_LARGEST
        self.settings: dict[str, Any] = header.settings
        self.comments = (GRID_COMMENT + json.dumps(header.grid_steps.to_json()),)
        self._model = self.container.read_model()
        self._entries = self.container.read_table()
        self._chunks = header.chunks()
        self._starts = np.array([chunk.start for chunk in self._chunks], np.int64)
        self._last: tuple[int, bool, GridScene] | None = None
        self._coming: Generator[tuple[int, GridScene], None, None] | None = None
        self._kernel: ChunkKernel | None = None
        self._tables: Generator[list[tuple[int, np.ndarray]], None, None] | None = None
        self._ready: dict[int, np.ndarray] = {}

    @property
    def threads(self) -> int:
        """Number of chunks that this machine decodes at once."""
        return thread_count(len(self._chunks))

    def grid(self) -> GridScene:
        """Decode every chunk, and return the codes of the whole scene."""
        count = len(self._chunks)
        if self._kernel is None:
            parts = list(in_order(lambda i: self._decode(i, False), range(count), self.threads))
        else:
            parts = [part for group in self._groups() for part in self._decode_group(group, False)]
        if not parts:
            return self._scene(Chunk(0, 0, 0), _nothing(self.sh_degree))

        names = (*CODES, "sh_degrees", "layer")
        joined: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names
        }
        bands = zip(*(part.sh for part in parts), strict=True)
        return replace(parts[0], count=self.count, sh=tuple(np.concatenate(band, axis=1) for band in bands), **joined)

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`; a chunk is decoded as a whole, but without its SH if they are not asked for."""
        rows, planes = self.begin_read(rows, fields, out)
        base_only = "sh_rest" not in planes
        for chunk, wanted, place in by_chunk(rows, self._starts):
            first = self._chunks[chunk].start
            here = slice(wanted.start - first, wanted.stop - first) if isinstance(wanted, slice) else wanted - first
            values = from_grid(self._part(chunk, base_only), here, fields)
            for field, plane in planes.items():
                plane[:, place] = values[field]
        return planes

    def read_table(self, rows: slice, out: np.ndarray) -> np.ndarray:
        """See `SceneSource.read_table`; within `on_device`, the device computes the values of whole chunks."""
        if self._kernel is None:
            return super().read_table(rows, out)
        for chunk, wanted, place in by_chunk(rows, self._starts):
            assert isinstance(wanted, slice)
            first = self._chunks[chunk].start
            table = self._table(chunk)[wanted.start - first : wanted.stop - first]
            if len(table) == rows.stop - rows.start:
                return table
            out[place] = table
        return out[: rows.stop - rows.start]

    @contextmanager
    def on_device(self, device: Device, chunks: int) -> Iterator[None]:
        """Decode on a device inside this context, several chunks at once; the results are the same.

        `device`: a kernel backend whose work-items run as threads of a processor. `chunks`: chunks decoded at once; see
        `device_bytes` for their memory.
        """
        longest = max((entry.section.length for entry in self._entries), default=0)
        self._kernel = ChunkKernel(device, self._model, self._most_rows, longest, chunks)
        try:
            yield
        finally:
            self._kernel.close()
            self._kernel = None
            self._ready.clear()

    def device_bytes(self, chunks: int) -> int:
        """Bytes, on the device and in host memory, for decoding so many chunks at once to rows of a PLY."""
        table = 4 * self._most_rows * (17 + self.width("sh_rest"))
        longest = max((entry.section.length for entry in self._entries), default=0)
        each = ChunkKernel.bytes_of(self._most_rows, self.sh_degree) + 3 * table + longest + (1 << 14)
        model = sum(tables.slots.nbytes + tables.entries.nbytes for tables in self._model.tables)
        return model + table + chunks * each + (1 << 16)

    @property
    def chunk_bytes(self) -> int:
        """Bytes for decoding a chunk by NumPy, beside `table_bytes`."""
        return self._most_rows * DECODE_BYTES

    @property
    def table_bytes(self) -> int:
        """Bytes of what NumPy looks symbols up in. It is made once, whatever the number of chunks."""
        return sum(tables.decoding_bytes for tables in self._model.tables)

    @property
    def _most_rows(self) -> int:
        return max((chunk.stop - chunk.start for chunk in self._chunks), default=0)

    @contextmanager
    def whole_in_order(self, threads: int) -> Iterator[None]:
        """Decode chunks ahead inside this context, in which all fields of all rows are read from first to last.

        `threads`: chunks that are held beside the current one; 1 decodes none ahead. A device decodes one group ahead.
        """
        if self._kernel is not None:
            self._tables = in_order(self._tables_of, self._groups(), 1, always=True)
        elif threads > 1:
            self._coming = in_order(lambda i: (i, self._decode(i, False)), range(len(self._chunks)), threads)
        try:
            yield
        finally:
            for coming in (self._coming, self._tables):
                if coming is not None:
                    coming.close()
            self._coming = self._tables = None

    def _part(self, chunk: int, base_only: bool) -> GridScene:
        if self._coming is not None and (self._last is None or self._last[0] != chunk):
            self._last = None
            for index, part in self._coming:
                if index == chunk:
                    self._last = (chunk, False, part)
                    break
        if self._last is None or self._last[0] != chunk or (self._last[1] and not base_only):
            self._last = None  # freed before the next chunk is decoded, so that memory holds one chunk
            self._last = (chunk, base_only, self._decode(chunk, base_only))
        return self._last[2]

    def _groups(self) -> list[range]:
        """Groups of chunks that the device decodes at once."""
        assert self._kernel is not None
        count, size = len(self._chunks), self._kernel.chunks
        return [range(start, min(start + size, count)) for start in range(0, count, size)]

    def _of(self, group: Sequence[int]) -> list[tuple[Chunk, ChunkEntry]]:
        return [(self._chunks[i], self._entries[i]) for i in group]

    def _decode_group(self, group: Sequence[int], base_only: bool) -> list[GridScene]:
        kernel = self._kernel
        assert kernel is not None
        codes = self.container.decode_on(lambda jobs: kernel.codes(jobs, base_only), self._of(group))
        return [self._scene(self._chunks[i], part) for i, part in zip(group, codes, strict=True)]

    def _tables_of(self, group: Sequence[int]) -> list[tuple[int, np.ndarray]]:
        kernel, header = self._kernel, self.container.header
        assert kernel is not None
        steps = RowSteps(header.low, header.grid_steps)
        tables = self.container.decode_on(lambda jobs: kernel.tables(jobs, steps), self._of(group))
        return list(zip(group, tables, strict=True))

    def _table(self, chunk: int) -> np.ndarray:
        if chunk not in self._ready:
            # Freed before the next group is taken: that one is decoded already.
            self._ready.clear()
            while self._tables is not None and chunk not in self._ready:
                coming = next(self._tables, None)
                if coming is None:
                    break
                self._ready = dict(coming)
            if chunk not in self._ready:
                self._ready = dict(self._tables_of([chunk]))
        return self._ready[chunk]

    def _decode(self, index: int, base_only: bool) -> GridScene:
        if self._kernel is not None:
            return self._decode_group([index], base_only)[0]
        chunk = self._chunks[index]
        codes = self.container.decode(self._model, chunk, self._entries[index], base_only)
        return self._scene(chunk, codes)

    def _scene(self, chunk: Chunk, codes: ChunkCodes) -> GridScene:
        header = self.container.header
        values = codes.base
        low = np.array(header.low, np.int32)[:, None]
        return GridScene(
            chunk.stop - chunk.start,
            self.sh_degree,
            self.origin,
            header.grid_steps,
            np.clip(codes.position + low, -CODE_LIMIT, CODE_LIMIT),
            np.stack([values[f"scale {axis}"] for axis in "xyz"]),
            np.stack([values[f"rotation {axis}"] for axis in "xyz"]),
            values["opacity"],
            np.stack([values[f"dc {colour}"] for colour in ("Y", "Co", "Cg")]),
            values["sh degree"].astype(np.uint8),
            codes.sh,
            np.full(chunk.stop - chunk.start, chunk.layer, np.uint8),
        )


def _nothing(sh_degree: int) -> ChunkCodes:
    """The codes of a scene without rows."""
    base = {kind.name: np.zeros(0, np.int32) for kind in base_kinds()}
    return ChunkCodes(
        np.zeros(0, np.uint64),
        base,
        tuple(np.zeros((3 * (2 * degree + 1), 0), np.int32) for degree in range(1, sh_degree + 1)),
    )
