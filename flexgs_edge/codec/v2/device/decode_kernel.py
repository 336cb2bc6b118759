"""Decode chunks by the OpenCL kernel `code_chunks`.

Its specification is `decode.decode_chunk`, which gives the same codes.
"""

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from threading import Lock
from typing import Any

import numpy as np

from flexgs_edge.codec.v2.device import launch
from flexgs_edge.codec.v2.header import check_end
from flexgs_edge.codec.v2.ports import SHARED, Model
from flexgs_edge.codec.v2.rans import StreamError, first_states, lane_count
from flexgs_edge.codec.v2.walk import ChunkCodes, TooManyNodes, base_kinds
from flexgs_edge.constants import CODE_LIMIT, RANS_LANES
from flexgs_edge.constants import RANS_PRECISION as PRECISION
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.scene.fields import sh_rest_count

_ROWS, _LANES, _WORDS, _STATUS, _FOUND, _FOUND_HIGH, _WANTED, _AT = range(len(launch.INFO))
_NO_WORDS, _NO_CHILDREN, _NODES, _REPEATS, _CODES, _DEGREES, _LANES_END = range(1, 8)


@dataclass(frozen=True)
class RowSteps:
    """The numbers that turn codes into values: the position code of the first cell, and the step sizes."""

    low: tuple[int, int, int]
    steps: StepSizes

    def packed(self) -> np.ndarray:
        """[6 + 2 D] f32: steps of position, scale, rotation, opacity, then of luma and chroma for every degree from 0."""
        steps = self.steps
        colours = [steps.colour(luma)[:2] for luma in (steps.dc, *steps.sh)]
        return np.concatenate([[steps.position, steps.scale, steps.rotation, steps.opacity], *colours]).astype(
            np.float32
        )


class ChunkKernel(launch.DeviceArrays):
    """Decodes several chunks of a file at once, one work-item each.

    `device`: a backend whose work-items run as threads of a processor. On a GPU, a chunk in one work-item would take
    far too long. `model`: the model of the file. `rows`: rows of the largest chunk. `data_bytes`: bytes of the longest
    chunk. `chunks`: number of chunks decoded at once.
    """

    def __init__(self, device: launch.Device, model: Model, rows: int, data_bytes: int, chunks: int) -> None:
        super().__init__(device)
        self.model, self.rows, self.chunks = model, rows, chunks
        self._stride = launch.padded(rows)
        self._word_stride = -(-data_bytes // 2) + RANS_LANES
        self._out_planes = _out_planes(model.sh_degree)
        self._lock = Lock()
        with ExitStack() as stack:
            stack.callback(self.close)
            for name, values in zip(("records", "slots", "entries"), pack_model(model), strict=True):
                device.write(self._array(name, values.shape, values.dtype), values)
            self._array("info", (chunks, len(launch.INFO)), np.int32)
            self._array("states", (chunks, RANS_LANES), np.uint32)
            self._array("words", (chunks, self._word_stride), np.uint16)
            for name, (planes, kind) in launch.PLANES.items():
                self._array(name, (chunks, planes, self._stride), np.dtype(kind))
            self._array("out", (chunks, self._out_planes, self._stride), np.int32)
            stack.pop_all()

    @staticmethod
    def bytes_of(rows: int, sh_degree: int) -> int:
        """Bytes that a chunk takes on the device, without its stream and its table of values."""
        work = sum(planes * np.dtype(kind).itemsize for planes, kind in launch.PLANES.values())
        return launch.padded(rows) * (work + 4 * _out_planes(sh_degree))

    def codes(self, chunks: Sequence[tuple[int, bytes]], base_only: bool) -> list[ChunkCodes | ValueError]:
        """Decode chunks (rows and bytes of each): the codes of each one, or the error that `decode.decode_chunk` raises."""
        with self._lock:
            errors = self._decode(chunks, base_only)
            return [
                self._codes(i, rows, base_only) if errors[i] is None else errors[i]
                for i, (rows, _) in enumerate(chunks)
            ]

    def tables(self, chunks: Sequence[tuple[int, bytes]], steps: RowSteps) -> list[np.ndarray | ValueError]:
        """As `codes`, but with values as rows of INRIA's PLY: [rows, columns] f32 each, as in `SceneSource.read_table`."""
        columns = 17 + 3 * sh_rest_count(self.model.sh_degree)
        with self._lock:
            errors = self._decode(chunks, False)
            counts = np.array([0 if errors[i] else rows for i, (rows, _) in enumerate(chunks)], np.int32)
            packed = steps.packed()
            self.device.write(self._array("counts", (self.chunks,), np.int32), counts)
            self.device.write(self._array("steps", packed.shape, np.float32), packed)
            table = self._array("table", (self.chunks, self.rows, columns), np.float32)
            self.device.launch(
                "grid_rows", (len(chunks),), self._stride, self._out_planes, self.model.sh_degree, columns, self.rows,
                *steps.low, *(self._arrays[name] for name in ("counts", "steps", "out")), table,
            )  # fmt: skip
            results: list[np.ndarray | ValueError] = []
            for i, (count, error) in enumerate(zip(counts.tolist(), errors, strict=True)):
                values = np.empty((count, columns), np.float32)
                self.device.read(table, values, i * self.rows * columns)
                if steps.steps.contraction is not None:
                    values[:, :3] = steps.steps.contraction.expand(values[:, :3].T).T
                results.append(error or values)
            return results

    def _decode(self, chunks: Sequence[tuple[int, bytes]], base_only: bool) -> list[Any]:
        """Decode chunks and leave the codes on the device; returns the error of each chunk, or None."""
        info = np.zeros((len(chunks), len(launch.INFO)), np.int32)
        errors: list[ValueError | None] = [None] * len(chunks)
        arrays = self._arrays
        for i, (rows, data) in enumerate(chunks):
            lanes = lane_count(rows)
            try:
                states = first_states(data, lanes)
            except StreamError as error:
                errors[i] = error
                continue
            words = np.zeros(len(data) // 2 - 2 * lanes + RANS_LANES, np.uint16)
            words[:-RANS_LANES] = np.frombuffer(data, "<u2", offset=4 * lanes)
            info[i, [_ROWS, _LANES, _WORDS]] = rows, lanes, len(data) // 2 - 2 * lanes
            self.device.write(arrays["states"], states, i * RANS_LANES)
            self.device.write(arrays["words"], words, i * self._word_stride)
        self.device.write(arrays["info"], info)
        launch.launch_coding(
            self.device,
            len(chunks),
            (self._stride, self._out_planes, self.model.sh_degree),
            [arrays[name] for name in ("info", "records", *launch.PLANES, "out")],
            decoding=(
                (self._word_stride, self.model.depth, int(base_only)),
                [arrays[name] for name in ("states", "words", "slots", "entries")],
            ),
        )
        self.device.read(arrays["info"], info)
        for i, ((rows, data), found) in enumerate(zip(chunks, info.tolist(), strict=True)):
            if errors[i] is None and found[_STATUS]:
                errors[i] = self._error(found, rows)
            elif errors[i] is None and not base_only:
                try:
                    check_end(data, rows, 4 * found[_LANES] + 2 * found[_AT])
                except StreamError as error:
                    errors[i] = error
        return errors

    def _codes(self, place: int, rows: int, base_only: bool) -> ChunkCodes:
        planes = _out_planes(0 if base_only else self.model.sh_degree)
        out = np.empty((planes, self._stride), np.int32)
        self.device.read(self._arrays["out"], out, place * self._out_planes * self._stride)
        cells = np.empty(rows, np.uint64)
        self.device.read(self._arrays["cells"], cells, place * 2 * self._stride)
        base = {kind.name: out[3 + i, :rows] for i, kind in enumerate(base_kinds())}
        sh, at = [], 3 + len(base)
        for degree in range(1, 0 if base_only else self.model.sh_degree + 1):
            count = int(np.count_nonzero(base["sh degree"] >= degree))
            sh.append(out[at : at + 6 * degree + 3, :count])
            at += 6 * degree + 3
        return ChunkCodes(cells, base, tuple(sh), out[:3, :rows])

    def _error(self, info: list[int], rows: int) -> ValueError:
        """The error that `decode.decode_chunk` raises for the same damage."""
        status, wanted = info[_STATUS], info[_WANTED]
        found = info[_FOUND_HIGH] << 32 | info[_FOUND] & 0xFFFFFFFF
        if status == _NODES:
            return TooManyNodes(f"octree: wanted at most {rows} nodes at level {wanted}, got {found}")
        if status == _CODES:
            return StreamError(f"{self.model.groups[wanted - SHARED].kind.name}: wanted codes within {CODE_LIMIT}")
        return StreamError(
            {
                _NO_WORDS: "stream: wanted more words, got its end",
                _NO_CHILDREN: "octree: wanted nodes with children, got one without",
                _REPEATS: f"repeats: wanted {wanted} in all, got {found}",
                _DEGREES: f"sh degree: wanted 0 to {self.model.sh_degree}, got {found} to {wanted}",
                _LANES_END: "stream: wanted every lane to end in its first state",
            }[status]
        )


def _out_planes(sh_degree: int) -> int:
    """Number of planes: positions, base channels, SH."""
    return 3 + len(base_kinds()) + 3 * sh_rest_count(sh_degree)


def pack_model(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pack a model for the kernel.

    Returns [alphabets, 203] i32 records; [tables, 2^14] u8, the symbol of every slot; [symbols of all tables] u32
    entries.
    """
    records = np.zeros((len(model.tables), launch.RECORD), np.int32)
    tables_before = entries_before = 0
    for i, (record, mapping, tables) in enumerate(zip(records, model.mappings, model.tables, strict=True)):
        record[launch.PLACES["symbols"]] = tables.size
        record[launch.PLACES["tables"] : launch.PLACES["counts"]] = (
            tables_before << PRECISION,
            len(tables.freqs) << PRECISION,
        )
        slot, entry = launch.PLACES["slots"], launch.PLACES["entries"]
        record[slot : slot + len(mapping)] = (tables_before + mapping.astype(np.int64)) << PRECISION
        record[entry : entry + len(mapping)] = entries_before + mapping.astype(np.int64) * tables.size
        if i >= SHARED:
            launch.pack_group(record, model.groups[i - SHARED])
        tables_before += len(tables.freqs)
        entries_before += tables.entries.size
    slots = np.concatenate([tables.slots for tables in model.tables])
    return records, slots, np.concatenate([tables.entries for tables in model.tables])
