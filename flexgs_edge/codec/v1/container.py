"""Write, open and verify `.fgs` files of version 1 (docs/format.md)."""

from __future__ import annotations

import os
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np

from flexgs_edge.codec.header import Section, format_error
from flexgs_edge.codec.sections import ChunkEntry, SectionFile, Verification, checked, preamble
from flexgs_edge.codec.v1.header import (
    CHUNK_ROWS,
    HEADER_MAX,
    HEADER_MIN,
    HEADER_STEP,
    Header,
    container_size,
    decode_header,
    encode_header,
)
from flexgs_edge.files import atomic_write
from flexgs_edge.packed.quantize import SMALLEST_STEP, QuantizedScene
from flexgs_edge.scene.fields import FIELDS

__all__ = ["Container", "Section", "container_size", "read_header", "verify", "write_container"]

VERSION = 1

Ranges = dict[str, tuple[np.ndarray, np.ndarray]]  # (low, step) of each field, [channels, G] f32 both


def write_container(
    path: str | os.PathLike[str], quantized: QuantizedScene, settings: Mapping[str, Any], *, force: bool = False
) -> int:
    """Write a quantized scene into a file, which gets its name only when it is complete.

    `path`: usually ends in `.fgs`. `quantized`: from `quantize_scene`. `settings`: JSON values that tell how the file
    was made; nothing that differs between runs or machines. `force`: replace an existing file. Returns bytes of the
    file, equal to `container_size`.
    """
    header = Header.of_scene(quantized, settings)
    block = encode_header(header)
    tables = b"".join(
        part.astype("<f4", copy=False).tobytes()
        for field in FIELDS
        for part in (quantized.arrays[field.name].low, quantized.arrays[field.name].step)
    )
    entries = []
    with atomic_write(path, force) as file:
        for part in (preamble(VERSION, header.file_size, block), block, checked(tables)):
            file.write(part)
        for chunk in range(header.chunk_count):
            checksum = 0
            for field, channel, length in header.planes(chunk):
                array = quantized.arrays[field]
                start = chunk * (CHUNK_ROWS // 8) * array.bits
                plane = array.planes[channel, start : start + length].tobytes()
                checksum = zlib.crc32(plane, checksum)
                file.write(plane)
            entries.append((header.chunk_bytes(chunk), checksum))
        file.write(checked(np.array(entries, "<u4").tobytes()))
        if file.tell() != header.file_size:
            raise AssertionError(f"wrote {file.tell()} bytes, the size model says {header.file_size}")
    return header.file_size


def read_header(path: str | os.PathLike[str]) -> Header:
    """Read and check the header of a file; neither ranges nor chunks are read."""
    return Container(path).header


class Container(SectionFile):
    """A file of version 1; its header is checked against the size of the file.

    `path`: the file is opened for each read, and never held open. Raises `FormatError` if anything differs from the
    format; the message names the byte, the expected and the found value. Raises `InputError` if the file cannot be read
    at all.
    """

    version = VERSION

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path)
        with self.open() as file:
            size = os.fstat(file.fileno()).st_size

            def wrong_size(header: Header) -> str:
                whole = header.file_size
                return "" if whole == size else f"its counts, bits and groups make a file of {whole}"

            self.header = self._read_header(file, size, _wrong_length, decode_header, wrong_size)

    def read_ranges(self) -> Ranges:
        """Read and check the range tables of all fields."""
        with self.open() as file:
            table = self.read_section(file, self.header.tables)
        numbers = np.frombuffer(table, "<f4").astype(np.float32, copy=False)
        ranges: Ranges = {}
        at = 0
        for field in FIELDS:
            shape = (2, self.header.width(field.name), self.header.groups[field.bits])
            size = shape[0] * shape[1] * shape[2]
            low, step = numbers[at : at + size].reshape(shape)
            self._check_ranges(field.name, low, step, self.header.tables.offset + 4 * at)
            ranges[field.name] = (low, step)
            at += size
        return ranges

    def read_chunk_table(self) -> list[ChunkEntry]:
        """Read and check the place and checksum of every chunk."""
        section = self.header.chunk_table
        with self.open() as file:
            table = np.frombuffer(self.read_section(file, section), "<u4").reshape(-1, 2)
        entries = []
        for i, (chunk, (length, checksum)) in enumerate(zip(self.header.chunks(), table.tolist(), strict=True)):
            if length != chunk.length:
                raise format_error(
                    self.path, section.offset + 8 * i, f"{chunk.name}: length: wanted {chunk.length}, got {length}"
                )
            entries.append(ChunkEntry(chunk, checksum))
        return entries

    def _check_ranges(self, field: str, low: np.ndarray, step: np.ndarray, offset: int) -> None:
        """Raise `FormatError` unless all values that codes can give are finite, and steps are zero or normal numbers."""
        codes = np.float32(2 ** self.header.bits.of(field) - 1)
        with np.errstate(over="ignore", invalid="ignore"):
            good = np.isfinite(low) & np.isfinite(low + codes * step) & ((step == 0) | (step >= SMALLEST_STEP))
        if not good.all():
            channel, group = np.argwhere(~good)[0]
            raise format_error(
                self.path,
                offset,
                f"ranges of {field}, channel {channel}, group {group}: wanted finite numbers and a step of 0 or a "
                f"normal positive number, got low {low[channel, group]}, step {step[channel, group]}",
            )


def verify(path: str | os.PathLike[str], raise_errors: bool = True) -> list[Section]:
    """Check every byte of a file, which is read in pieces.

    `path`: the file. `raise_errors`: if False, report damage after the header as `ok=False` instead of raising an
    error. Returns all sections in the order of the file.
    """
    container = Container(path)
    header = container.header
    found = Verification(header.block, raise_errors)
    found.check(header.tables, container.read_ranges)
    # Without a valid table the chunks cannot be compared with anything: they count as damaged.
    return found.check_chunks(container, header.chunk_table, container.read_chunk_table, header.chunks())


def _wrong_length(length: int, room: int) -> str:
    most = min(HEADER_MAX, room)
    if length % HEADER_STEP == 0 and HEADER_MIN <= length <= most:
        return ""
    return f"wanted a multiple of {HEADER_STEP} from {HEADER_MIN} to {most}"
