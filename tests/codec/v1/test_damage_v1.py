"""Every damaged or hostile container is an error that names its place."""

from __future__ import annotations

import struct
import tracemalloc
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
from flexgs_edge.codec.v1.container import read_header, verify, write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.errors import FormatError
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.scene.fields import FIELDS
from quantized_scenes import make_scene, quantize_all

NAMES = [field.name for field in FIELDS]


@pytest.fixture
def small(tmp_path: Path) -> Path:
    path = tmp_path / "small.fgs"
    size = write_container(path, quantize_all(make_scene(9), BitSpec(9, 4, 4, 5, 3, 2)), {"near": 0.2})
    assert size < 6000
    return path


def test_every_flipped_bit_is_found(small: Path) -> None:
    check_every_flipped_bit(small)


def test_every_truncation_is_found(small: Path) -> None:
    check_every_truncation(small, FgsSource)


def test_damage_is_an_error_where_it_is_read(small: Path) -> None:
    sections = {section.name: section for section in verify(small)}
    flip(small, "chunk 0", 3, 1)
    source = FgsSource(small)
    for _ in range(2):
        with pytest.raises(FormatError, match=f"byte {sections['chunk 0'].offset}: chunk 0: checksum: wanted"):
            source.read(slice(0, 1), ["means"])
    with pytest.raises(FormatError):
        source.quantized()


@pytest.mark.parametrize("damaged", ["ranges", "chunk 0", "chunk table"])
def test_verify_lists_the_damaged_sections(small: Path, damaged: str) -> None:
    good = verify(small)
    assert sum(section.length for section in good) == small.stat().st_size
    flip(small, damaged)
    with pytest.raises(FormatError, match=damaged):
        verify(small)
    bad = {section.name for section in verify(small, raise_errors=False) if not section.ok}
    # Chunks cannot be judged without their table.
    assert bad == ({damaged, "chunk 0"} if damaged == "chunk table" else {damaged})


def test_flags_formats_and_versions(small: Path) -> None:
    check_flags(small, FgsSource)


@pytest.mark.parametrize("length", [0, 1024, 2049, 3072, 1 << 21, 2**32 - 1024, 2**32 - 1])
def test_header_lengths(small: Path, length: int) -> None:
    overwrite(small, 24, "<I", length)
    with pytest.raises(FormatError, match="byte 24: header length"):
        FgsSource(small)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (put("count", value=-1), "count: wanted an integer from 0"),
        (put("count", value=2**32), "count: wanted"),
        (put("count", value=10**4000), "count: wanted .* got an integer of more than 40 digits"),
        (put("count", value=True), "count: wanted"),
        (put("count", value=9.0), "count: wanted"),
        (put("count", value="9"), "count: wanted"),
        (put("count", value=None), "count: wanted"),
        (put("count", value=2**32 - 1), "make a file of"),
        (put("count", value=10), "make a file of"),
        (put("count", value=8), "make a file of"),
        (put("sh_count", value=10), "sh_count: wanted an integer from 0 to 9"),
        (put("sh_count", value=0), "sh_degree: wanted an integer from 0 to 0"),
        (put("sh_degree", value=0), "sh_degree: wanted an integer from 1 to 4"),
        (put("sh_degree", value=5), "sh_degree: wanted"),
        (put("sh_degree", value=2), "make a file of"),
        (put("origin", value=[0.0, 1.0]), "origin: wanted three"),
        (put("origin", value=[0.0, 1.0, "2"]), "origin: wanted three"),
        (put("origin", value=[0.0, 1.0, 2]), "origin: wanted three"),
        (put("origin", value=[0.0, 1.0, float("nan")]), "wanted finite numbers, got NaN"),
        (put("origin", value=[0.0, 1.0, float("inf")]), "wanted finite numbers, got Infinity"),
        (put("origin", value={}), "origin: wanted three"),
        (put("bits", "xyz", value=0), "bits.xyz: wanted an integer from 1 to 16"),
        (put("bits", "xyz", value=17), "bits.xyz: wanted"),
        (put("bits", "xyz", value=[8]), "bits.xyz: wanted"),
        (put("bits", "colour", value=8), "bits: wanted an object with the keys"),
        (put("bits", value=[1, 2]), "bits: wanted an object"),
        (put("bits", "dc", value=5), "make a file of"),
        (put("groups", "dc", value=0), "groups.dc: wanted an integer from 1 to 9"),
        (put("groups", "dc", value=10), "groups.dc: wanted"),
        (put("groups", "dc", value=2), "make a file of"),
        (put("groups", value={}), "groups: wanted an object with the keys"),
        (put("settings", value=[]), "settings: wanted an object"),
        (put("more", value=1), "wanted an object with the keys"),
        (lambda record: record.pop("count"), "wanted an object with the keys"),
    ],
)
def test_hostile_headers(small: Path, change: Callable[[dict[str, Any]], object], message: str) -> None:
    if message.startswith("count: wanted .* got an integer of"):
        # Longer than the header's fixed block allows; 1000 digits are as absurd.
        change = put("count", value=10**1000)
    edit_header(small, change, 2048)
    with pytest.raises(FormatError, match=message):
        read_header(small)


@pytest.mark.parametrize(("text", "message"), HEADERS_THAT_ARE_NONE)
def test_headers_that_are_no_json_of_ours(small: Path, text: bytes, message: str) -> None:
    write_header(small, text, 2048)
    with pytest.raises(FormatError, match=message):
        read_header(small)


def test_absurd_claims_allocate_nothing(small: Path) -> None:
    def change(record: dict[str, Any]) -> None:
        record.update(count=2**32 - 1, sh_count=2**32 - 1, sh_degree=4)
        record["groups"] = dict.fromkeys(record["groups"], 2**32 - 1)

    edit_header(small, change, 2048)
    tracemalloc.start()
    with pytest.raises(FormatError, match="make a file of"):
        FgsSource(small)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 200_000


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_ranges_that_are_not_finite(small: Path, value: float) -> None:
    reseal_section(small, "ranges", lambda body: struct.pack_into("<f", body, 8, value))
    with pytest.raises(FormatError, match="ranges of means, channel 2, group 0: wanted finite"):
        FgsSource(small)
    assert [section.name for section in verify(small, raise_errors=False) if not section.ok] == ["ranges"]


@pytest.mark.parametrize("value", [-1.0, 1e-40, 3e38, np.nan])
def test_steps_that_decode_to_nonsense(small: Path, value: float) -> None:
    reseal_section(small, "ranges", lambda body: struct.pack_into("<f", body, 12, value))
    with pytest.raises(FormatError, match="ranges of means, channel 0, group 0: wanted finite"):
        FgsSource(small)


def test_chunk_lengths_are_compared(small: Path) -> None:
    reseal_section(small, "chunk table", lambda body: struct.pack_into("<I", body, 0, 1))
    with pytest.raises(FormatError, match="chunk 0: length: wanted .* got 1"):
        FgsSource(small)


def test_a_file_that_shrinks_while_open(small: Path) -> None:
    source = FgsSource(small)
    with open(small, "r+b") as file:
        file.truncate(2200)
    with pytest.raises(FormatError, match="the file is truncated"):
        source.read(slice(0, 1), NAMES)


def test_random_garbage(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    path = tmp_path / "garbage.fgs"
    for length in (0, 1, 35, 36, 2084, 5000):
        path.write_bytes(rng.bytes(length))
        with pytest.raises(FormatError):
            FgsSource(path)
