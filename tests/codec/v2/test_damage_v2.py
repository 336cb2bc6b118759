"""Every damaged or hostile file of version 2 is an error that names its place."""

from __future__ import annotations

import struct
import tracemalloc
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fgs_damage import (
    HEADERS_THAT_ARE_NONE,
    check_every_flipped_bit,
    check_every_truncation,
    check_flags,
    edit_header,
    flip,
    overwrite,
    put,
    reseal_section,
    write_header,
)
from flexgs_edge.codec.open_fgs import read_header, verify
from flexgs_edge.codec.v2.container import GridContainer, channel_bytes, trim_container, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.errors import FormatError
from flexgs_edge.scene.fields import FIELDS
from grid_scenes import make_grid

NAMES = [field.name for field in FIELDS]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.fgs"
    assert write_grid(path, make_grid(9, 1, layers=2), {"near": 0.2}) < 2500
    return path


def test_every_flipped_bit_is_found(small: Path) -> None:
    check_every_flipped_bit(small)


def test_every_truncation_is_found(small: Path) -> None:
    check_every_truncation(small, GridContainer)


@pytest.mark.parametrize("damaged", ["model", "chunk 0", "chunk 1", "chunk table"])
def test_damage_is_named_wherever_it_is_met(small: Path, tmp_path: Path, damaged: str) -> None:
    flip(small, damaged)
    uses: list[Callable[[], object]] = [
        lambda: verify(small),
        lambda: GridSource(small).grid(),
        lambda: channel_bytes(small),
        lambda: trim_container(small, tmp_path / "cut.fgs", 10**6),
    ]
    for use in uses:
        with pytest.raises(FormatError, match=damaged):
            use()
    assert [path.name for path in tmp_path.iterdir()] == ["small.fgs"]
    bad = {section.name for section in verify(small, raise_errors=False) if not section.ok}
    # Chunks cannot be told apart without their table.
    assert bad == ({damaged, "chunks"} if damaged == "chunk table" else {damaged})


def test_flags_formats_and_versions(small: Path) -> None:
    check_flags(small, GridContainer)


@pytest.mark.parametrize("length", [1 << 21, 2**32 - 1])
def test_header_lengths(small: Path, length: int) -> None:
    overwrite(small, 24, "<I", length)
    with pytest.raises(FormatError, match="byte 24: header length"):
        read_header(small)


def claim(count: int, chunk_rows: int = 65536) -> Callable[[dict[str, Any]], object]:
    return lambda record: record.update(count=count, layers=[count], chunk_rows=chunk_rows)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("count", value=-1), "count: wanted an integer from 0"),
        (put("count", value=10**3000), "count: wanted .* got an integer of more than 40 digits"),
        (put("count", value=True), "count: wanted"),
        (put("count", value=10), "layers: wanted 1 to 256 counts that add up to 10"),
        (put("layers", value=[]), "layers: wanted 1 to 256"),
        (put("layers", value=[0] * 256 + [9]), "layers: wanted 1 to 256"),
        (put("layers", value=[10, -1]), "layers: wanted an integer from 0"),
        (put("layers", value="9"), "layers: wanted a list"),
        (claim(2**32 - 1), "make a file of at least"),
        (claim(2**32 - 1, 1), "make a file of at least"),
        (claim(100_000), "make a file of at least"),
        (put("chunk_rows", value=0), "chunk_rows: wanted an integer from 1 to 65536"),
        (put("chunk_rows", value=65537), "chunk_rows: wanted"),
        (put("depth", value=22), "depth: wanted an integer from 0 to 21"),
        (put("low", value=[0, 0]), "low: wanted three"),
        (put("low", value=[0, 0, 2**25]), "low: wanted an integer"),
        (put("model_bytes", value=10**6), "make a file of at least"),
        (put("model_bytes", value=2**21), "model_bytes: wanted"),
        (put("sh_degree", value=5), "sh_degree: wanted"),
        (put("sh_degree", value=2), "steps.sh: wanted 2 numbers"),
        (put("steps", "dc", value=0.0), "steps: step of dc: expected positive"),
        (put("steps", "dc", value=0.1), "steps: wanted float32 numbers"),
        (put("steps", "dc", value=1), "steps: wanted finite numbers"),
        (put("steps", "dc", value=1e300), "steps"),
        (put("steps", "sh", value=[None]), "steps: wanted finite"),
        (put("steps", value=[]), "steps: wanted an object"),
        (put("origin", value=[0.0, 1.0, 2]), "origin: wanted three"),
        (put("origin", value=[0.0, 1.0, float("nan")]), "wanted finite numbers, got NaN"),
        (put("channels", value=[]), "channels: wanted an object"),
        (put("channels", "bytes", value=[1]), "channels: wanted 7 bytes and 1 rows"),
        (put("channels", "rows", value=[1, 2]), "channels: wanted 7 bytes and 1 rows"),
        (put("channels", "rows", value=[10**6]), "channels.rows: wanted"),
        (put("channels", "bytes", value=[-1] * 7), "channels.bytes: wanted"),
        (put("cut_from", value={"bytes": 1}), "cut_from: wanted null or an object"),
        (put("cut_from", value={"bytes": 1, "count": -1, "layers": 1}), "cut_from.count: wanted"),
        (put("settings", value=[]), "settings: wanted an object"),
        (put("more", value=1), "wanted an object with the keys"),
        (lambda record: record.pop("count"), "wanted an object with the keys"),
    ],
)
def test_hostile_headers(small: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    edit_header(small, change)
    tracemalloc.start()
    with pytest.raises(FormatError, match=message), np.errstate(over="ignore"):
        read_header(small)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


@pytest.mark.parametrize(("text", "message"), HEADERS_THAT_ARE_NONE)
def test_headers_that_are_no_json_of_ours(small: Path, text: bytes, message: str) -> None:
    write_header(small, text)
    with pytest.raises(FormatError, match=message):
        read_header(small)


def test_claims_that_do_not_fit_the_chunks(small: Path) -> None:
    edit_header(small, lambda record: record.update(layers=[9]))
    with pytest.raises(FormatError, match=r"chunk table: checksum|chunk table: wanted chunks that end at"):
        GridSource(small)


@pytest.mark.parametrize("value", [0, 1, 3, 2**32 - 2])
def test_chunk_lengths(small: Path, value: int) -> None:
    reseal_section(small, "chunk table", lambda body: struct.pack_into("<I", body, 0, value))
    with pytest.raises(FormatError, match=r"chunk 0: length|chunks that end at"):
        GridSource(small)


def test_sealed_nonsense_is_a_format_error(small: Path) -> None:
    """Damage under correct checksums: decoding ends in bounded time, with a value or with a `FormatError`."""
    good = small.read_bytes()
    sections = {section.name: section for section in verify(small)}
    table = sections["chunk table"].offset
    rng = np.random.default_rng(0)
    failed = 0
    for trial in range(100):
        small.write_bytes(good)
        chunk = trial % 2
        section = sections["model" if trial % 4 < 2 else f"chunk {chunk}"]
        data = bytearray(good)
        at = section.offset + int(rng.integers(section.length - 4))
        data[at : at + 2] = rng.bytes(2)
        body = bytes(data[section.offset : section.offset + section.length])
        if section.name == "model":
            struct.pack_into("<I", data, section.offset + section.length - 4, zlib.crc32(body[:-4]))
        else:
            struct.pack_into("<I", data, table + 8 * chunk + 4, zlib.crc32(body))
            struct.pack_into("<I", data, len(data) - 4, zlib.crc32(data[table:-4]))
        small.write_bytes(data)
        verify_passes = [section.ok for section in verify(small, raise_errors=False)]
        try:
            scene = GridSource(small)
            assert all(verify_passes)
            planes = scene.read(slice(0, 9), NAMES)
            assert all(np.isfinite(plane).all() for plane in planes.values())
        except FormatError:
            failed += 1
    assert failed > 25


def test_a_file_that_shrinks_while_open(small: Path) -> None:
    source = GridSource(small)
    with open(small, "r+b") as file:
        file.truncate(source.container.header.model.offset)
    with pytest.raises(FormatError, match="the file is truncated"):
        source.read(slice(0, 1), NAMES)
