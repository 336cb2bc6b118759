"""Write, open and verify `.fgs` files of version 1, and their header (docs/format.md)."""

import os
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flexgs_edge.codec import sections
from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write
from flexgs_edge.packed.bitpack import BitSpec, plane_bytes
from flexgs_edge.packed.quantize import SMALLEST_STEP, QuantizedScene, group_count
from flexgs_edge.scene.contraction import Contraction
from flexgs_edge.scene.fields import FIELD, FIELDS

VERSION = 1
Ranges = dict[str, tuple[np.ndarray, np.ndarray]]  # (low, step) of each field, [channels, G] f32 both
CHUNK_ROWS = 65536  # Rows of a chunk: a multiple of 8, so that each plane ends at a whole byte for any number of bits
HEADER_STEP = 1024  # Headers are padded to a multiple of this many bytes
HEADER_MIN = 2048
"""Least bytes of a header; normal ones fit, so that the size of a file does not depend on the digits of its numbers."""
HEADER_MAX = 1 << 20
HEADER_OWN = 512  # Most bytes of the header without the settings (counts of 10 digits, numbers of 24)
_KEYS = ("bits", "count", "groups", "origin", "settings", "sh_count", "sh_degree")


@dataclass(frozen=True)
class Header:
    """The header of a version 1 file. `count`, `sh_count`, `sh_degree`: as in `QuantizedScene`."""

    count: int
    sh_count: int
    sh_degree: int
    origin: tuple[float, float, float]  # world position that the means are relative to
    bits: BitSpec  # bits per code
    groups: dict[str, int]  # groups per channel, by the attribute names of `BitSpec`
    settings: dict[str, Any]  # how the file was made (JSON values)
    block: int = HEADER_MIN  # bytes of the padded header in the file
    contraction: Contraction | None = None  # as in `QuantizedScene`

    @classmethod
    def of_scene(cls, scene: QuantizedScene, settings: Mapping[str, Any]) -> "Header":
        """Make the header of a quantized scene; raises `InputError` for settings that JSON cannot hold."""
        groups = {FIELD[name].bits: array.groups for name, array in scene.arrays.items()}
        x, y, z = (float(value) for value in scene.origin)
        counts = (scene.count, scene.sh_count, scene.sh_degree)
        return cls(*counts, (x, y, z), scene.bits, groups, dict(settings), header_block(settings), scene.contraction)

    def rows(self, field: str) -> int:
        """Rows of the array of `field`."""
        return self.sh_count if field == "sh_rest" else self.count

    def width(self, field: str) -> int:
        """Number of channels of `field`."""
        return FIELD[field].width(self.sh_degree)

    @property
    def tables(self) -> sections.Section:
        """Section of the range tables, with their checksum."""
        pairs = sum(self.width(field.name) * self.groups[field.bits] for field in FIELDS)
        return sections.Section("ranges", sections.PREAMBLE_BYTES + self.block, 8 * pairs + 4)

    @property
    def chunk_count(self) -> int:
        """Number of chunks."""
        return -(-self.count // CHUNK_ROWS)

    def chunk_rows(self, chunk: int, field: str) -> int:
        """Rows of `field` in a chunk; SH cover fewer rows."""
        return min(max(self.rows(field) - chunk * CHUNK_ROWS, 0), CHUNK_ROWS)

    def chunk_bytes(self, chunk: int) -> int:
        """Bytes of a chunk: all its planes."""
        return sum(
            self.width(field.name) * plane_bytes(self.chunk_rows(chunk, field.name), self.bits.of(field.name))
            for field in FIELDS
        )

    def planes(self, chunk: int) -> Iterator[tuple[str, int, int]]:
        """Yield (field, channel, bytes) of each plane of a chunk, in the order of the file."""
        for field in FIELDS:
            length = plane_bytes(self.chunk_rows(chunk, field.name), self.bits.of(field.name))
            for channel in range(self.width(field.name)):
                yield field.name, channel, length

    def chunks(self) -> Iterator[sections.Section]:
        """Yield the sections of the chunks in order."""
        offset = self.tables.offset + self.tables.length
        for chunk in range(self.chunk_count):
            length = self.chunk_bytes(chunk)
            yield sections.Section(f"chunk {chunk}", offset, length)
            offset += length

    @property
    def payload(self) -> int:
        """Bytes of all chunks. A sum over fields: a loop over chunks could be endless if a claimed count is absurd."""
        return sum(self.width(f.name) * plane_bytes(self.rows(f.name), self.bits.of(f.name)) for f in FIELDS)

    @property
    def chunk_table(self) -> sections.Section:
        """Section of the chunk table (lengths and checksums of chunks), with its own checksum."""
        offset = self.tables.offset + self.tables.length + self.payload
        return sections.Section("chunk table", offset, 8 * self.chunk_count + 4)

    @property
    def file_size(self) -> int:
        """Bytes of the whole file, from the header alone."""
        return self.chunk_table.offset + self.chunk_table.length


def container_size(
    count: int,
    sh_count: int,
    sh_degree: int,  # degree of the scene; counts as 0 if `sh_count` is 0
    bits: BitSpec,  # bits per code
    groups: int | None = None,  # as for `quantize_scene`
    settings: Mapping[str, Any] | None = None,
) -> int:
    """Exact size of a container in bytes, before anything is quantized.

    `count`, `sh_count`: rows, and rows with SH. `settings`: needed only if their JSON is longer than `HEADER_MIN -
    HEADER_OWN` bytes.
    """
    if sh_degree == 0 or sh_count == 0:
        sh_degree = sh_count = 0
    per_field = {field.bits: group_count(sh_count if field.name == "sh_rest" else count, groups) for field in FIELDS}
    block = header_block(settings or {})
    return Header(count, sh_count, sh_degree, (0.0, 0.0, 0.0), bits, per_field, {}, block).file_size


def header_block(settings: Mapping[str, Any]) -> int:
    """Bytes of the padded header; they depend only on the length of the settings."""
    wanted = len(sections.canonical_json(dict(settings))) + HEADER_OWN
    block = max(HEADER_MIN, -(-wanted // HEADER_STEP) * HEADER_STEP)
    if block > HEADER_MAX:
        raise InputError(f"settings: {wanted} bytes of JSON, expected at most {HEADER_MAX - HEADER_OWN}")
    return block


def encode_header(header: Header) -> bytes:
    """The bytes of a header, padded."""
    record = asdict(header)
    del record["block"]  # known from the preamble
    if header.contraction is None:
        del record["contraction"]
    return sections.canonical_json(record).ljust(header.block)


def decode_header(block: bytes) -> Header:
    """Read and check a padded header; raises `HeaderError` for everything that `encode_header` does not write."""
    record = sections.parse_json(block)
    if not isinstance(record, dict) or tuple(sorted(record.keys() - {"contraction"})) != _KEYS:
        raise sections.HeaderError(
            f"wanted an object with the keys {', '.join(_KEYS)} and perhaps contraction, got {sections.shown(record)}"
        )
    count = sections.checked_integer("count", record["count"], 0, sections.MAX_COUNT)
    sh_count = sections.checked_integer("sh_count", record["sh_count"], 0, count)
    lowest, highest = (1, MAX_SH_DEGREE) if sh_count else (0, 0)
    sh_degree = sections.checked_integer("sh_degree", record["sh_degree"], lowest, highest)
    bits = BitSpec(
        **{name: sections.checked_integer(f"bits.{name}", v, 1, 16) for name, v in _attributes("bits", record["bits"])}
    )
    groups = {}
    for field in FIELDS:
        rows = sh_count if field.name == "sh_rest" else count
        value = dict(_attributes("groups", record["groups"]))[field.bits]
        groups[field.bits] = sections.checked_integer(f"groups.{field.bits}", value, min(rows, 1), rows)
    settings = record["settings"]
    if not isinstance(settings, dict):
        raise sections.HeaderError(f"settings: wanted an object, got {sections.shown(settings)}")
    contraction = sections.checked_contraction(record["contraction"]) if "contraction" in record else None
    origin = sections.checked_origin(record["origin"])
    return Header(count, sh_count, sh_degree, origin, bits, groups, settings, len(block), contraction)


def _attributes(name: str, value: object) -> list[tuple[str, object]]:
    names = sorted(field.bits for field in FIELDS)
    if not isinstance(value, dict) or sorted(value) != names:
        raise sections.HeaderError(
            f"{name}: wanted an object with the keys {', '.join(names)}, got {sections.shown(value)}"
        )
    return list(value.items())


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
        for part in (sections.preamble(VERSION, header.file_size, block), block, sections.checked(tables)):
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
        file.write(sections.checked(np.array(entries, "<u4").tobytes()))
        if file.tell() != header.file_size:
            raise AssertionError(f"wrote {file.tell()} bytes, the size model says {header.file_size}")
    return header.file_size


def read_header(path: str | os.PathLike[str]) -> Header:
    """Read and check the header of a file; neither ranges nor chunks are read."""
    return Container(path).header


class Container(sections.SectionFile):
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
            self.header = self._read_header(file, size, _wrong_length, decode_header)
        whole = self.header.file_size
        if whole != size:
            words = f"header: its counts, bits and groups make a file of {whole} bytes, got {size}"
            raise self._error(sections.PREAMBLE_BYTES, words)

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

    def read_chunk_table(self) -> list[sections.ChunkEntry]:
        """Read and check the place and checksum of every chunk."""
        section = self.header.chunk_table
        with self.open() as file:
            table = np.frombuffer(self.read_section(file, section), "<u4").reshape(-1, 2)
        entries = []
        for i, (chunk, (length, checksum)) in enumerate(zip(self.header.chunks(), table.tolist(), strict=True)):
            if length != chunk.length:
                raise sections.format_error(
                    self.path, section.offset + 8 * i, f"{chunk.name}: length: wanted {chunk.length}, got {length}"
                )
            entries.append(sections.ChunkEntry(chunk, checksum))
        return entries

    def _check_ranges(self, field: str, low: np.ndarray, step: np.ndarray, offset: int) -> None:
        """Raise `FormatError` unless all values that codes can give are finite, and steps are zero or normal numbers."""
        codes = np.float32(2 ** self.header.bits.of(field) - 1)
        with np.errstate(over="ignore", invalid="ignore"):
            good = np.isfinite(low) & np.isfinite(low + codes * step) & ((step == 0) | (step >= SMALLEST_STEP))
        if not good.all():
            channel, group = np.argwhere(~good)[0]
            raise sections.format_error(
                self.path,
                offset,
                f"ranges of {field}, channel {channel}, group {group}: wanted finite numbers and a step of 0 or a "
                f"normal positive number, got low {low[channel, group]}, step {step[channel, group]}",
            )


def verify(path: str | os.PathLike[str], raise_errors: bool = True) -> list[sections.Section]:
    """Check every byte of a file, which is read in pieces.

    `path`: the file. `raise_errors`: if False, report damage after the header as `ok=False` instead of raising an
    error. Returns all sections in the order of the file.
    """
    container = Container(path)
    header = container.header
    found = sections.Verification(header.block, raise_errors)
    found.check(header.tables, container.read_ranges)
    # Without a valid table the chunks cannot be compared with anything: they count as damaged.
    return found.check_chunks(container, header.chunk_table, container.read_chunk_table, header.chunks())


def _wrong_length(length: int, room: int) -> str:
    most = min(HEADER_MAX, room)
    if length % HEADER_STEP == 0 and HEADER_MIN <= length <= most:
        return ""
    return f"wanted a multiple of {HEADER_STEP} from {HEADER_MIN} to {most}"
