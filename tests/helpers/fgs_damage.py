"""Damage to `.fgs` files of both versions, under correct checksums and without."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.codec.open_fgs import verify
from flexgs_edge.errors import FormatError

Change = Callable[[dict[str, Any]], object]


@contextmanager
def away(path: Path) -> Iterator[None]:
    """While this lasts, the file is not there: a source has what it holds, and nothing else."""
    aside = path.rename(path.with_suffix(".away"))
    try:
        yield
    finally:
        aside.rename(path)


def reseal(data: bytearray) -> bytes:
    """Correct file size, header crc and preamble crc after a change of the header."""
    length = struct.unpack_from("<I", data, 24)[0]
    struct.pack_into("<QII", data, 16, len(data), length, zlib.crc32(data[36 : 36 + length]))
    struct.pack_into("<I", data, 32, zlib.crc32(data[:32]))
    return bytes(data)


def write_header(path: Path, text: bytes, block: int = 0) -> None:
    """Another header in the place of a file's own, padded to `block` bytes."""
    data = path.read_bytes()
    length = struct.unpack_from("<I", data, 24)[0]
    assert len(text) <= block or not block
    text = text.ljust(block)
    changed = bytearray(data[:36] + text + data[36 + length :])
    struct.pack_into("<I", changed, 24, len(text))
    path.write_bytes(reseal(changed))


def edit_header(path: Path, change: Change, block: int = 0) -> None:
    """Change the JSON record of a file and seal it again."""
    length = struct.unpack_from("<I", path.read_bytes(), 24)[0]
    record = json.loads(path.read_bytes()[36 : 36 + length])
    change(record)
    write_header(path, json.dumps(record).encode(), block)


def put(*keys: str, value: object) -> Change:
    """Set one value of a record."""

    def change(record: dict[str, Any]) -> None:
        for key in keys[:-1]:
            record = record[key]
        record[keys[-1]] = value

    return change


def overwrite(path: Path, offset: int, layout: str, value: int, sealed: bool = True) -> None:
    """Write a number over a file's bytes."""
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, offset, value)
    path.write_bytes(reseal(data) if sealed else data)


def flip(path: Path, section: str, place: int = 0, bits: int = 0x80) -> None:
    """Flip bits of a byte in a section."""
    at = next(found.offset for found in verify(path) if found.name == section) + place
    overwrite(path, at, "<B", path.read_bytes()[at] ^ bits, sealed=False)


def reseal_section(path: Path, name: str, change: Callable[[bytearray], object]) -> None:
    """Change a section that ends in its own checksum, and correct that."""
    section = next(section for section in verify(path) if section.name == name)
    data = bytearray(path.read_bytes())
    body = data[section.offset : section.offset + section.length - 4]
    change(body)
    data[section.offset : section.offset + section.length] = body + struct.pack("<I", zlib.crc32(body))
    path.write_bytes(data)


def check_every_flipped_bit(path: Path) -> None:
    """`verify` finds each of them."""
    good = path.read_bytes()
    missed = []
    with open(path, "r+b", buffering=0) as file:
        for at, byte in enumerate(good):
            for bit in range(8):
                file.seek(at)
                file.write(bytes([byte ^ 1 << bit]))
                try:
                    verify(path)
                    missed.append((at, bit))
                except FormatError:
                    pass
            file.seek(at)
            file.write(bytes([byte]))
    assert missed == []
    assert path.read_bytes() == good
    verify(path)


def check_every_truncation(path: Path, read: Callable[[Path], object]) -> None:
    """Opening finds each of them, and extra bytes."""
    good = path.read_bytes()
    for tail in (b"\0", b"x" * 4096):
        path.write_bytes(good + tail)
        with pytest.raises(FormatError, match="byte 16: file size: wanted .* truncated or extended"):
            read(path)
    path.write_bytes(good)
    for length in range(len(good) - 1, -1, -1):
        with open(path, "r+b") as file:
            file.truncate(length)
        with pytest.raises(FormatError, match=rf"{path.name}: byte \d+: .*wanted .*got"):
            read(path)


def check_flags(path: Path, read: Callable[[Path], object]) -> None:
    """Those that may be ignored are, those that must be understood are refused; other formats and versions too."""
    good = path.read_bytes()
    overwrite(path, 12, "<I", 0x80000001)
    verify(path)
    version = good[8]
    for offset, layout, value, message in (
        (10, "<H", 4, "byte 10: flags that must be understood: wanted 0, got 0x4"),
        (8, "<H", 3 - version, f"byte 8: version: wanted {version}, got {3 - version}"),
        (0, "<B", 0x50, "byte 0: magic"),
    ):
        overwrite(path, offset, layout, value)
        with pytest.raises(FormatError, match=message):
            read(path)
        path.write_bytes(good)


HEADERS_THAT_ARE_NONE = [
    (b"", "wanted JSON"),
    (b"[]", "wanted an object"),
    (b"{", "wanted JSON"),
    (b'{"count":1,"count":1}', "wanted each key once, got 'count' twice"),
    (b'{"settings":{"a":1,"a":2}}', "wanted each key once, got 'a' twice"),
    (b"[" * 2000, "wanted JSON"),
    (b'{"count":\xff}', "wanted JSON in ASCII"),
    (b'{"count":1}\0', "wanted JSON"),
    (b'{"count":-Infinity}', "wanted finite numbers"),
]
"""JSON that is not ours, and what is said of it."""
