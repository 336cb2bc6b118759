"""Encode by OpenCL kernels: `code_chunks` counts as `ports.CountPort` does, `encode_chunks` codes as `rans.Encoder` does."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any

import numpy as np

from flexgs_edge.codec.v2.device import launch
from flexgs_edge.codec.v2.groups import Group
from flexgs_edge.codec.v2.ports import SHARED, CountPort, Raw
from flexgs_edge.codec.v2.rans import Encoder
from flexgs_edge.codec.v2.walk import ChunkCodes, base_kinds
from flexgs_edge.constants import COARSE_ROWS, RANS_LANES
from flexgs_edge.scene.fields import sh_rest_count

_ESCAPES = 32
"""One in so many codes may be an escape, with 4 raw bytes each. A chunk with more of them is left to NumPy."""


def device_bytes(rows: int, sh_degree: int) -> int:
    """Most bytes on a device for coding a chunk of so many rows."""
    work = sum(planes * np.dtype(kind).itemsize for planes, kind in launch.PLANES.values())
    # A code, its context and symbol, three raw bytes (four for an escape, which is rare), then 6 bytes a symbol.
    return launch.padded(rows) * (work + 10 * (len(base_kinds()) + 3 * sh_rest_count(sh_degree))) + (1 << 22)


class CountKernel(launch.DeviceArrays):
    """Counts the symbols of several chunks at once, one work-item each; NumPy counts those of positions.

    `device`: a backend whose work-items run as threads of a processor. `groups`: the groups of the model. `sh_degree`:
    SH degree of the scene. `rows`: rows of the largest chunk. `chunks`: number of chunks counted at once.
    """

    def __init__(self, device: launch.Device, groups: list[Group], sh_degree: int, rows: int, chunks: int) -> None:
        super().__init__(device)
        self.groups, self.sh_degree = groups, sh_degree
        self._stride = launch.padded(rows)
        self._planes = len(base_kinds()) + 3 * sh_rest_count(sh_degree)
        sizes = [group.contexts * group.symbols for group in groups]
        self._first = np.concatenate([[0], np.cumsum(sizes)]).tolist()
        records = np.zeros((SHARED + len(groups), launch.RECORD), np.int32)
        for record, group, first in zip(records[SHARED:], groups, self._first, strict=False):
            record[launch.PLACES["symbols"]], record[launch.PLACES["counts"]] = group.symbols, first
            launch.pack_group(record, group)
        self._log, self._raw = self._planes * rows, (self._planes * rows // _ESCAPES + 64) * 4
        shifts = [-(-group.shift // 8) for group in groups]
        channels = [1] * len(base_kinds()) + [2 * d + 1 for d in range(1, sh_degree + 1) for _ in range(3)]
        self._raw += rows * sum(pieces * count for pieces, count in zip(shifts, channels, strict=True))
        self._batches = self._planes * (max((rows - 1) // COARSE_ROWS, 0).bit_length() + 1)
        shapes: dict[str, tuple[tuple[int, ...], str]] = {
            **{name: ((planes, self._stride), kind) for name, (planes, kind) in launch.PLANES.items()},
            "codes": ((self._planes, self._stride), "i4"),
            "contexts": ((self._log,), "u1"),
            "symbols": ((self._log,), "u1"),
            "raw": ((self._raw,), "u1"),
            "counts": ((self._first[-1],), "u4"),
            "batches": ((self._batches, 3), "u4"),
        }
        self._sizes = {name: int(np.prod(shape)) for name, (shape, _) in shapes.items()}
        with ExitStack() as stack:
            stack.callback(self.close)
            self._array("info", (chunks, len(launch.INFO)), np.int32)
            device.write(self._array("records", records.shape, np.int32), records)
            for name, (shape, kind) in shapes.items():
                self._array(name, (chunks, *shape), np.dtype(kind))
            stack.pop_all()

    def count(self, chunks: Sequence[ChunkCodes], ports: Sequence[CountPort]) -> list[bool]:
        """Count chunks, and add each to its port; False for a chunk with too many escapes, which is not added."""
        info = np.zeros((len(chunks), len(launch.INFO)), np.int32)
        for i, codes in enumerate(chunks):
            rows = len(codes.cells)
            info[i, launch.INFO.index("rows")] = rows
            planes = np.zeros((self._planes, self._stride), np.int32)
            planes[: len(codes.base), :rows] = [codes.base[kind.name] for kind in base_kinds()]
            at = len(codes.base)
            for band in codes.sh:
                planes[at : at + len(band), : band.shape[1]] = band
                at += len(band)
            self._write("codes", i, planes)
            self._write("cells", i, codes.cells)
        self.device.write(self._arrays["info"], info)
        arrays = self._arrays
        launch.launch_coding(
            self.device,
            len(chunks),
            (self._stride, self._planes, self.sh_degree),
            [arrays[name] for name in ("info", "records", *launch.PLANES, "codes")],
            counting=(
                (self._log, self._raw, self._first[-1], self._batches),
                [arrays[name] for name in ("contexts", "symbols", "raw", "counts", "batches")],
            ),
        )
        self.device.read(self._arrays["info"], info)
        counted = info[:, launch.INFO.index("status")] == 0
        for place in np.flatnonzero(counted).tolist():
            self._add(place, info[place].tolist(), ports[place])
        return [bool(done) for done in counted]

    def _add(self, place: int, info: list[int], port: CountPort) -> None:
        batches = self._read("batches", place, (info[launch.INFO.index("at")], 3), np.uint32).astype(np.int64)
        counts = self._read("counts", place, (self._first[-1],), np.uint32).astype(np.int64)
        for i, (group, first) in enumerate(zip(self.groups, self._first, strict=False)):
            shape = port.counts[SHARED + i].shape
            port.counts[SHARED + i] += counts[first : first + group.contexts * group.symbols].reshape(shape)
        total = int(batches[:, 1].sum())
        contexts, symbols = (self._read(name, place, (total,), np.uint8) for name in ("contexts", "symbols"))
        raw = self._read("raw", place, (info[launch.INFO.index("words")],), np.uint8)
        at = raw_at = 0
        for alphabet, size, escapes in batches.tolist():
            shift = self.groups[alphabet - SHARED].shift
            pieces: list[Raw] = []
            plain = [(min(shift - bit, 8), size - escapes) for bit in range(0, shift, 8)]
            for bits, count in [*plain, *[(8, escapes)] * 4]:
                if count:
                    pieces.append((bits, raw[raw_at : raw_at + count]))
                    port.raw[alphabet] += bits * count
                    raw_at += count
            port.batches.append((alphabet, contexts[at : at + size], symbols[at : at + size], pieces))
            at += size

    def _write(self, name: str, place: int, values: np.ndarray) -> None:
        self.device.write(self._arrays[name], values, place * self._sizes[name])

    def _read(self, name: str, place: int, shape: tuple[int, ...], kind: Any) -> np.ndarray:
        values = np.empty(shape, kind)
        return self.device.read(self._arrays[name], values, place * self._sizes[name])


def encode_streams(device: launch.Device, encoders: Sequence[Encoder]) -> list[bytes]:
    """Do `Encoder.finish` for several encoders at once, one work-item each."""
    sizes = [[len(batch) for batch in encoder.batches] for encoder in encoders]
    most, batch_most = max(map(sum, sizes), default=0) + 1, max(map(len, sizes), default=0) + 1
    count = len(encoders)
    about = np.array([(encoder.lanes, len(encoder.batches)) for encoder in encoders], np.uint32)
    shapes = [(count, 2), (count, batch_most), (count, most), (count, RANS_LANES), (count, most), (count,)]
    with ExitStack() as stack:
        arrays = []
        for shape, kind in zip(shapes, ("u4", "u4", "u4", "u4", "u2", "u4"), strict=True):
            arrays.append(device.array(shape, np.dtype(kind)))
            stack.callback(arrays[-1].release)
        device.write(arrays[0], about)
        for i, (encoder, batch_sizes) in enumerate(zip(encoders, sizes, strict=True)):
            device.write(arrays[1], np.array(batch_sizes, np.uint32), i * batch_most)
            device.write(arrays[2], np.concatenate([np.zeros(0, np.uint32), *encoder.batches]), i * most)
        device.launch("encode_chunks", (count,), most, batch_most, *arrays)
        written = device.read(arrays[5]).tolist()
        streams = []
        for i, (encoder, words) in enumerate(zip(encoders, written, strict=True)):
            states = device.read(arrays[3], np.empty(encoder.lanes, np.uint32), i * RANS_LANES)
            stream = device.read(arrays[4], np.empty(words, np.uint16), (i + 1) * most - words)
            streams.append(states.astype("<u4").tobytes() + stream.astype("<u2").tobytes())
        return streams
