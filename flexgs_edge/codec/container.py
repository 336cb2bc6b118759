"""Writing, opening and verifying `.fgs` files, version 1 (docs/format.md).

Every byte lies under a checksum, or is compared with the one value it may have. Nothing is allocated on the word of
the header before the sizes that it implies add up to the size of the file.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.codec.layout import (
    CHUNK_ROWS,
    HEADER_MAX,
    HEADER_MIN,
    HEADER_STEP,
    PREAMBLE_BYTES,
    Header,
    HeaderError,
    Section,
    container_size,
    decode_header,
    encode_header,
    format_error,
)
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.quantize import SMALLEST_STEP, QuantizedScene
from flexgs_edge.scene.atomic import atomic_write
from flexgs_edge.scene.fields import FIELDS

__all__ = ["Container", "Section", "container_size", "read_header", "verify", "write_container"]

MAGIC = b"\x93FGS\r\n\x1a\n"
"""A byte above 127, both line ends and a text stop: transfers that alter text break it at once (the idea of PNG)."""
VERSION = 1
_PREAMBLE = struct.Struct("<8sHHIQII")
_U32 = struct.Struct("<I")
_PIECE = 1 << 20
"""Bytes read at a time when only a checksum is wanted."""

Ranges = dict[str, tuple[np.ndarray, np.ndarray]]
"""(low, step) by field, each [channels, G] f32."""


def write_container(
    path: str | os.PathLike[str], quantized: QuantizedScene, settings: Mapping[str, Any], *, force: bool = False
) -> int:
    """Write a quantized scene; the file appears under its name only when it is complete.

    Parameters
    ----------
    path : path
        Usually ends in `.fgs`.
    quantized : QuantizedScene
        From `quantize_scene`.
    settings : mapping
        JSON values that say how the file was made: nothing that differs between runs or machines.
    force : bool, optional
        Replace a file that exists.

    Returns
    -------
    int
        Bytes of the file, as `container_size` predicts.
    """
    header = Header.of_scene(quantized, settings)
    block = encode_header(header)
    fixed = _PREAMBLE.pack(MAGIC, VERSION, 0, 0, header.file_size, len(block), zlib.crc32(block))
    tables = b"".join(
        part.astype("<f4", copy=False).tobytes()
        for field in FIELDS
        for part in (quantized.arrays[field.name].low, quantized.arrays[field.name].step)
    )
    entries = []
    with atomic_write(path, force) as file:
        for part in (_checked(fixed), block, _checked(tables)):
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
        file.write(_checked(np.array(entries, "<u4").tobytes()))
        if file.tell() != header.file_size:
            raise AssertionError(f"wrote {file.tell()} bytes, the size model says {header.file_size}")
    return header.file_size


def read_header(path: str | os.PathLike[str]) -> Header:
    """The checked header of a file; neither ranges nor chunks are read."""
    return Container(path).header


@dataclass(frozen=True)
class ChunkEntry:
    """Where a chunk lies and its checksum."""

    section: Section
    checksum: int


class Container:
    """A `.fgs` file whose header has been checked against the file's size.

    Parameters
    ----------
    path : path
        The file; opened for each read, never held.

    Raises
    ------
    FormatError
        When anything differs from the format; names the byte, what was wanted and what was found.
    InputError
        When the file cannot be read at all.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        with self._open() as file:
            self.header = self._read_header(file)

    def read_ranges(self) -> Ranges:
        """The range tables of all fields, checked."""
        with self._open() as file:
            table = self._read_checked(file, self.header.tables)
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
        """Place and checksum of every chunk, checked."""
        section = self.header.chunk_table
        with self._open() as file:
            table = np.frombuffer(self._read_checked(file, section), "<u4").reshape(-1, 2)
        entries = []
        for i, (chunk, (length, checksum)) in enumerate(zip(self.header.chunks(), table.tolist(), strict=True)):
            if length != chunk.length:
                raise format_error(
                    self.path, section.offset + 8 * i, f"{chunk.name}: length: wanted {chunk.length}, got {length}"
                )
            entries.append(ChunkEntry(chunk, checksum))
        return entries

    def read_chunk(self, entry: ChunkEntry) -> bytes:
        """The planes of a chunk, checked."""
        section = entry.section
        with self._open() as file:
            file.seek(section.offset)
            data = self._read(file, section.length, section.name)
        self._compare(section, entry.checksum, zlib.crc32(data))
        return data

    def check_chunk(self, entry: ChunkEntry) -> None:
        """Check a chunk in pieces, without keeping it."""
        left, checksum = entry.section.length, 0
        with self._open() as file:
            file.seek(entry.section.offset)
            while left:
                piece = self._read(file, min(left, _PIECE), entry.section.name)
                checksum = zlib.crc32(piece, checksum)
                left -= len(piece)
        self._compare(entry.section, entry.checksum, checksum)

    @contextmanager
    def _open(self) -> Iterator[BinaryIO]:
        try:
            with open(self.path, "rb") as file:
                yield file
        except OSError as error:
            raise InputError(f"{self.path}: cannot read it ({error.strerror})") from error

    def _read(self, file: BinaryIO, length: int, name: str) -> bytes:
        offset = file.tell()
        data = file.read(length)
        if len(data) != length:
            raise format_error(
                self.path, offset, f"{name}: wanted {length} bytes, got {len(data)}: the file is truncated"
            )
        return data

    def _read_header(self, file: BinaryIO) -> Header:
        size = os.fstat(file.fileno()).st_size
        preamble = self._read(file, PREAMBLE_BYTES, "preamble")
        magic, version, required, _, claimed, block_bytes, block_sum = _PREAMBLE.unpack_from(preamble)
        if magic != MAGIC:
            raise format_error(self.path, 0, f"magic: wanted {MAGIC!r}, got {magic!r}: not a .fgs file, or damaged")
        if version != VERSION:
            raise format_error(
                self.path, 8, f"version: wanted {VERSION}, got {version}: a newer program wrote it, or it is damaged"
            )
        self._compare(Section("preamble", 0, 0), _U32.unpack_from(preamble, 32)[0], zlib.crc32(preamble[:32]))
        if required:
            raise format_error(
                self.path, 10, f"flags that must be understood: wanted 0, got {required:#x}: a newer program wrote it"
            )
        if claimed != size:
            raise format_error(self.path, 16, f"file size: wanted {claimed}, got {size}: truncated or extended")
        room = min(HEADER_MAX, size - PREAMBLE_BYTES)
        if block_bytes % HEADER_STEP or not HEADER_MIN <= block_bytes <= room:
            raise format_error(
                self.path,
                24,
                f"header length: wanted a multiple of {HEADER_STEP} from {HEADER_MIN} to {room}, got {block_bytes}",
            )
        block = self._read(file, block_bytes, "header")
        self._compare(Section("header", PREAMBLE_BYTES, 0), block_sum, zlib.crc32(block))
        try:
            header = decode_header(block)
        except HeaderError as error:
            raise format_error(self.path, PREAMBLE_BYTES, f"header: {error}") from None
        if header.file_size != size:
            raise format_error(
                self.path,
                PREAMBLE_BYTES,
                f"header: its counts, bits and groups make a file of {header.file_size} bytes, got {size}",
            )
        return header

    def _read_checked(self, file: BinaryIO, section: Section) -> bytes:
        """A section's bytes without the checksum at its end."""
        file.seek(section.offset)
        data = self._read(file, section.length, section.name)
        self._compare(section, _U32.unpack_from(data, section.length - 4)[0], zlib.crc32(memoryview(data)[:-4]))
        return data[:-4]

    def _compare(self, section: Section, wanted: int, got: int) -> None:
        if wanted != got:
            raise format_error(
                self.path,
                section.offset,
                f"{section.name}: checksum: wanted {wanted:08x}, got {got:08x}: the file is damaged",
            )

    def _check_ranges(self, field: str, low: np.ndarray, step: np.ndarray, offset: int) -> None:
        """Every value that can come out must be finite; steps are zero or normal numbers."""
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
    """Check every byte of a file, reading it in pieces.

    Parameters
    ----------
    path : path
        The file.
    raise_errors : bool, optional
        False: damage after the header is reported as `ok=False` instead.

    Returns
    -------
    list of Section
        All sections in the order of the file.
    """
    container = Container(path)
    header = container.header
    sections = [Section("preamble", 0, PREAMBLE_BYTES), Section("header", PREAMBLE_BYTES, header.block)]

    def check(section: Section, test: Callable[[], object]) -> bool:
        try:
            test()
        except FormatError:
            if raise_errors:
                raise
            sections.append(replace(section, ok=False))
            return False
        sections.append(section)
        return True

    check(header.tables, container.read_ranges)
    # Without the table there is nothing to compare the chunks with: they count as damaged.
    if check(header.chunk_table, container.read_chunk_table):
        for entry in container.read_chunk_table():
            check(entry.section, partial(container.check_chunk, entry))
    else:
        sections += [replace(section, ok=False) for section in header.chunks()]
    return sorted(sections, key=lambda section: section.offset)


def _checked(data: bytes) -> bytes:
    """Data with its checksum behind it."""
    return data + _U32.pack(zlib.crc32(data))
