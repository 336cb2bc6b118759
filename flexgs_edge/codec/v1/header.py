"""The header of a version 1 `.fgs` file: its fields, its checks, and the places and sizes of all sections (docs/format.md)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

from flexgs_edge.codec.header import (
    MAX_COUNT,
    PREAMBLE_BYTES,
    HeaderError,
    Section,
    canonical_json,
    checked_contraction,
    checked_integer,
    checked_origin,
    parse_json,
    shown,
)
from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.packed.bitpack import plane_bytes
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.packed.quantize import QuantizedScene, group_count
from flexgs_edge.scene.contraction import Contraction
from flexgs_edge.scene.fields import FIELD, FIELDS

CHUNK_ROWS = 65536  # Rows of a chunk: a multiple of 8, so that each plane ends at a whole byte for any number of bits
HEADER_STEP = 1024  # Headers are padded to a multiple of this many bytes
HEADER_MIN = 2048
"""Least bytes of a header; normal ones fit, so that the size of a file does not depend on the digits of its numbers."""
HEADER_MAX = 1 << 20
HEADER_OWN = 512  # Most bytes of the header without the settings (counts of 10 digits, numbers of 24)
_KEYS = ("bits", "count", "groups", "origin", "settings", "sh_count", "sh_degree")


@dataclass(frozen=True)
class Header:
    """The header of a version 1 file.

    `count`, `sh_count`, `sh_degree`: as in `QuantizedScene`.
    """

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
    def of_scene(cls, scene: QuantizedScene, settings: Mapping[str, Any]) -> Header:
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
    def tables(self) -> Section:
        """Section of the range tables, with their checksum."""
        pairs = sum(self.width(field.name) * self.groups[field.bits] for field in FIELDS)
        return Section("ranges", PREAMBLE_BYTES + self.block, 8 * pairs + 4)

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

    def chunks(self) -> Iterator[Section]:
        """Yield the sections of the chunks in order."""
        offset = self.tables.offset + self.tables.length
        for chunk in range(self.chunk_count):
            length = self.chunk_bytes(chunk)
            yield Section(f"chunk {chunk}", offset, length)
            offset += length

    @property
    def payload(self) -> int:
        """Bytes of all chunks. A sum over fields: a loop over chunks could be endless if a claimed count is absurd."""
        return sum(self.width(f.name) * plane_bytes(self.rows(f.name), self.bits.of(f.name)) for f in FIELDS)

    @property
    def chunk_table(self) -> Section:
        """Section of the chunk table (lengths and checksums of chunks), with its own checksum."""
        offset = self.tables.offset + self.tables.length + self.payload
        return Section("chunk table", offset, 8 * self.chunk_count + 4)

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
    wanted = len(canonical_json(dict(settings))) + HEADER_OWN
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
    return canonical_json(record).ljust(header.block)


def decode_header(block: bytes) -> Header:
    """Read and check a padded header; raises `HeaderError` for everything that `encode_header` does not write."""
    record = parse_json(block)
    if not isinstance(record, dict) or tuple(sorted(record.keys() - {"contraction"})) != _KEYS:
        raise HeaderError(
            f"wanted an object with the keys {', '.join(_KEYS)} and perhaps contraction, got {shown(record)}"
        )
    count = checked_integer("count", record["count"], 0, MAX_COUNT)
    sh_count = checked_integer("sh_count", record["sh_count"], 0, count)
    lowest, highest = (1, MAX_SH_DEGREE) if sh_count else (0, 0)
    sh_degree = checked_integer("sh_degree", record["sh_degree"], lowest, highest)
    bits = BitSpec(
        **{name: checked_integer(f"bits.{name}", v, 1, 16) for name, v in _attributes("bits", record["bits"])}
    )
    groups = {}
    for field in FIELDS:
        rows = sh_count if field.name == "sh_rest" else count
        value = dict(_attributes("groups", record["groups"]))[field.bits]
        groups[field.bits] = checked_integer(f"groups.{field.bits}", value, min(rows, 1), rows)
    settings = record["settings"]
    if not isinstance(settings, dict):
        raise HeaderError(f"settings: wanted an object, got {shown(settings)}")
    contraction = checked_contraction(record["contraction"]) if "contraction" in record else None
    origin = checked_origin(record["origin"])
    return Header(count, sh_count, sh_degree, origin, bits, groups, settings, len(block), contraction)


def _attributes(name: str, value: object) -> list[tuple[str, object]]:
    names = sorted(field.bits for field in FIELDS)
    if not isinstance(value, dict) or sorted(value) != names:
        raise HeaderError(f"{name}: wanted an object with the keys {', '.join(names)}, got {shown(value)}")
    return list(value.items())
