"""The header of a version 2 `.fgs` file: its fields, its checks, and the places of all sections (docs/format.md)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

from flexgs_edge.codec.sections import (
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
from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.constants import CODE_LIMIT, MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import POSITION_BITS, StepSizes

COUNT_MOST = 2**53 - 1  # Largest number of bytes or rows: every JSON reader keeps integers up to here exactly
HEADER_MOST = 1 << 20
MODEL_MOST = 1 << 20  # Most bytes of the model; 59 alphabets of 256 symbols and 64 tables need less
LAYERS_MOST = 256
PREVIEW_MOST = 1 << 24
PREVIEW_KEY = len(',"preview_bytes":16777216')
"""Most bytes of a preview, and most bytes by which it makes the header longer."""
_KEYS = (
    "chunk_rows", "count", "cut_from", "depth", "layers", "low", "model_bytes", "origin", "settings", "sh_degree",
    "steps",
)  # fmt: skip
_OPTIONAL = "channels", "preview_bytes"
CHUNK_ROWS = 65536


@dataclass(frozen=True)
class Channels:
    """Bytes of each kind in `channel_parts`, rounded, and the number of rows with SH of at least degree 1, 2 and so on."""

    bytes: tuple[int, ...]
    rows: tuple[int, ...]

    @classmethod
    def of(cls, taken: Mapping[str, float], rows: Sequence[int]) -> Channels:
        """Make the record from the bytes of each alphabet (as in `channel_bytes`) and the rows of each degree from 1 on."""
        parts = channel_parts(len(rows)).values()
        return cls(tuple(round(sum(taken[part] for part in some)) for some in parts), tuple(map(int, rows)))


def channel_parts(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """The kinds of value in version 2, and the alphabets of each."""
    parts: dict[str, tuple[str, ...]] = {"position": ("position", "repeats")}
    parts |= {name: tuple(f"{name} {axis}" for axis in "xyz") for name in ("scale", "rotation")}
    parts |= {"opacity": ("opacity",), "dc": ("dc Y", "dc Co", "dc Cg"), "sh degree": ("sh degree",)}
    return parts | {f"sh {d}": tuple(f"sh {d} {c}" for c in ("Y", "Co", "Cg")) for d in range(1, sh_degree + 1)}


@dataclass(frozen=True)
class GridHeader:
    """The header of a version 2 file. `count`, `sh_degree`: as in `GridScene`."""

    count: int
    sh_degree: int
    origin: tuple[float, float, float]  # world position that positions are relative to
    steps: dict[str, Any]  # the step sizes, from `StepSizes.to_json`
    layers: tuple[int, ...]  # rows of each layer
    chunk_rows: int  # rows of a chunk; the last chunk of a layer may have fewer
    depth: int  # levels of the octrees
    low: tuple[int, int, int]  # position code of the octrees' first cell
    model_bytes: int  # bytes of the model
    settings: dict[str, Any]  # how the file was made
    cut_from: dict[str, int] | None = None  # `bytes`, `count` and `layers` of the file that this one was cut from
    # Sizes that readers need not decode chunks for; None in files that were cut, and in files of early writers.
    channels: Channels | None = None
    preview_bytes: int | None = None  # bytes of the preview, a small file of the same scene; None if there is none
    block: int = 0
    version: int = 2

    @classmethod
    def of_grid(
        cls,
        grid: GridScene,
        layers: Sequence[int],
        low: Sequence[int],
        depth: int,
        chunk_rows: int,
        model_bytes: int,
        settings: Mapping[str, Any],
        channels: Channels | None = None,
        preview_bytes: int | None = None,
    ) -> GridHeader:
        """Make the header of a scene; raises `InputError` for settings that JSON cannot hold."""
        x, y, z = (float(value) for value in grid.origin)
        a, b, c = (int(value) for value in low)
        header = cls(
            grid.count, grid.sh_degree, (x, y, z), grid.step_sizes.to_json(), tuple(int(rows) for rows in layers), chunk_rows,
            depth, (a, b, c), model_bytes, dict(settings), channels=channels, preview_bytes=preview_bytes,
        )  # fmt: skip
        return header.sealed()

    def sealed(self) -> GridHeader:
        """A copy with its own length filled in."""
        length = len(encode_header(self))
        if length > HEADER_MOST:
            raise InputError(f"settings: the header has {length} bytes of JSON, expected at most {HEADER_MOST}")
        return replace(self, block=length)

    def cut(self, layers: int, size: int) -> GridHeader:
        """The header for the first `layers` layers of this file, which has `size` bytes."""
        source = self.cut_from or {"bytes": size, "count": self.count, "layers": len(self.layers)}
        kept = self.layers[:layers]
        return replace(self, count=sum(kept), layers=kept, cut_from=source, channels=None).sealed()

    @property
    def grid_steps(self) -> StepSizes:
        """The step sizes."""
        return StepSizes.from_json(self.steps)

    @property
    def chunk_count(self) -> int:
        """Number of chunks of all layers."""
        return sum(-(-rows // self.chunk_rows) for rows in self.layers)

    def chunks(self) -> list[Chunk]:
        """The chunks in the order of the file."""
        return plan_chunks(list(self.layers), self.chunk_rows)

    @property
    def model(self) -> Section:
        """Section of the model, with its checksum."""
        return Section("model", PREAMBLE_BYTES + self.block, self.model_bytes + 4)

    @property
    def preview(self) -> Section:
        """Section of the preview, which checks itself; of no bytes if there is none."""
        return Section("preview", self.model.offset + self.model.length, self.preview_bytes or 0)

    @property
    def chunks_offset(self) -> int:
        """Where the first chunk begins."""
        return self.preview.offset + self.preview.length

    @property
    def table_bytes(self) -> int:
        """Bytes of the chunk table, with its checksum."""
        return 8 * self.chunk_count + 4

    def table(self, size: int) -> Section:
        """Section of the chunk table, at the end of a file of `size` bytes."""
        return Section("chunk table", size - self.table_bytes, self.table_bytes)

    @property
    def least_size(self) -> int:
        """Bytes of the smallest file with this header; a chunk has at least a bit a row."""
        return self.chunks_offset + self.table_bytes + self.count // 8


def encode_header(header: GridHeader) -> bytes:
    """The bytes of a header."""
    record = asdict(header)
    del record["block"], record["version"]  # known from the preamble
    for name in _OPTIONAL:
        if record[name] is None:
            del record[name]
    return canonical_json(record)


def decode_header(block: bytes) -> GridHeader:
    """Read and check a header; raises `HeaderError` for everything that `encode_header` does not write."""
    record = parse_json(block)
    if not isinstance(record, dict) or tuple(sorted(record.keys() - set(_OPTIONAL))) != _KEYS:
        raise HeaderError(
            f"wanted an object with the keys {', '.join(_KEYS)} and perhaps {', '.join(_OPTIONAL)}, got {shown(record)}"
        )
    count = checked_integer("count", record["count"], 0, MAX_COUNT)
    layers = _integers("layers", record["layers"], 0, MAX_COUNT)
    if not 1 <= len(layers) <= LAYERS_MOST or sum(layers) != count:
        raise HeaderError(f"layers: wanted 1 to {LAYERS_MOST} counts that add up to {count}, got {shown(list(layers))}")
    low = _integers("low", record["low"], -CODE_LIMIT, CODE_LIMIT)
    if len(low) != 3:
        raise HeaderError(f"low: wanted three integers, got {shown(list(low))}")
    if not isinstance(record["settings"], dict):
        raise HeaderError(f"settings: wanted an object, got {shown(record['settings'])}")
    sh_degree = checked_integer("sh_degree", record["sh_degree"], 0, MAX_SH_DEGREE)
    return GridHeader(
        count,
        sh_degree,
        checked_origin(record["origin"]),
        _steps(record["steps"], sh_degree),
        layers,
        checked_integer("chunk_rows", record["chunk_rows"], 1, CHUNK_ROWS),
        checked_integer("depth", record["depth"], 0, POSITION_BITS),
        (low[0], low[1], low[2]),
        checked_integer("model_bytes", record["model_bytes"], 0, MODEL_MOST),
        record["settings"],
        _cut_from(record["cut_from"]),
        _channels(record["channels"], count, sh_degree) if "channels" in record else None,
        checked_integer("preview_bytes", record["preview_bytes"], 1, PREVIEW_MOST)
        if "preview_bytes" in record
        else None,
        len(block),
    )


def _steps(value: object, sh_degree: int) -> dict[str, Any]:
    names = ("chroma", "dc", "opacity", "position", "rotation", "scale", "sh")
    if not isinstance(value, dict) or tuple(sorted(value.keys() - {"contraction"})) != names:
        raise HeaderError(
            f"steps: wanted an object with the keys {', '.join(names)} and perhaps contraction, got {shown(value)}"
        )
    numbers = [value[name] for name in names[:-1]]
    if not isinstance(value["sh"], list) or len(value["sh"]) != sh_degree:
        raise HeaderError(f"steps.sh: wanted {sh_degree} numbers, got {shown(value['sh'])}")
    numbers += value["sh"]
    if not all(type(number) is float and math.isfinite(number) for number in numbers):
        raise HeaderError(f"steps: wanted finite numbers with a decimal point, got {shown(value)}")
    if "contraction" in value:
        checked_contraction(value["contraction"])
    try:
        steps = StepSizes.from_json(value).to_json()
    except (InputError, OverflowError) as error:
        raise HeaderError(f"steps: {error}") from None
    if steps != value:
        raise HeaderError(f"steps: wanted float32 numbers, got {shown(value)}")
    return steps


def _cut_from(value: object) -> dict[str, int] | None:
    if value is None:
        return None
    if not isinstance(value, dict) or tuple(sorted(value)) != ("bytes", "count", "layers"):
        raise HeaderError(f"cut_from: wanted null or an object with bytes, count and layers, got {shown(value)}")
    return {name: checked_integer(f"cut_from.{name}", value[name], 0, 2**63 - 1) for name in sorted(value)}


def _channels(value: object, count: int, sh_degree: int) -> Channels:
    if not isinstance(value, dict) or tuple(sorted(value)) != ("bytes", "rows"):
        raise HeaderError(f"channels: wanted an object with bytes and rows, got {shown(value)}")
    taken = _integers("channels.bytes", value["bytes"], 0, COUNT_MOST)
    rows = _integers("channels.rows", value["rows"], 0, count)
    kinds = len(channel_parts(sh_degree))
    if len(taken) != kinds or len(rows) != sh_degree:
        raise HeaderError(f"channels: wanted {kinds} bytes and {sh_degree} rows, got {shown(value)}")
    return Channels(taken, rows)


def _integers(name: str, value: object, lowest: int, highest: int) -> tuple[int, ...]:
    if not isinstance(value, list):
        raise HeaderError(f"{name}: wanted a list of integers, got {shown(value)}")
    return tuple(checked_integer(name, number, lowest, highest) for number in value)


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows [start, stop) of a scene, all in one layer."""

    layer: int
    start: int
    stop: int


def plan_chunks(layers: list[int], chunk_rows: int = CHUNK_ROWS) -> list[Chunk]:
    """The chunks of a scene, from the number of rows in each layer."""
    chunks, at = [], 0
    for layer, count in enumerate(layers):
        for start in range(at, at + count, chunk_rows):
            chunks.append(Chunk(layer, start, min(start + chunk_rows, at + count)))
        at += count
    return chunks


def least_bytes(rows: int) -> int:
    """Least bytes of a chunk of so many rows: a bit a row, rounded up to an even number."""
    return -(-rows // 16) * 2


def check_end(data: bytes, rows: int, used: int) -> None:
    """Raise `StreamError` unless `used` bytes are the whole stream, or only zeros pad it to the least size of a chunk."""
    if any(data[used:]) or (len(data) > used and len(data) != least_bytes(rows)):
        raise StreamError(f"stream: wanted {used} bytes, got {len(data)}")
