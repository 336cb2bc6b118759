"""Damages small files in ways that a reader must survive: bytes, words of texts, values of JSON, sections of containers.

Every function draws its choices from a given `random.Random`, so that the same seed makes the same file.
"""

from __future__ import annotations

import functools
import gzip
import io
import json
import random
import re
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Sequence

import zstandard

from flexgs_edge.codec.open_fgs import verify
from flexgs_edge.codec.sections import Section
from flexgs_edge.codec.v1.container import HEADER_STEP

NUMBERS = (0, 1, 2, 3, 0x7F, 0x80, 0xFF, 0x100, 0x7FFF, 0xFFFF, 0x10000, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF)


def nested(depth: int) -> list[object]:
    """A list nested `depth` times."""
    value: list[object] = []
    for _ in range(depth):
        value = [value]
    return value


VALUES: tuple[object, ...] = (
    0, -1, 1, 2**16, 2**31, 2**32 - 1, 2**63, 10**30, 0.5, 1e300, 5e-324, -0.0, float("nan"), float("inf"), True, None, "", "1",
    "\ud800", [], [1], [[]], {}, {"a": 1}, "x" * 3000,
    nested(700),
)  # fmt: skip
"""Values that replace a value of JSON."""
WORDS = (*b"0 -1 1e999 1e308 nan inf 99999999999999999999 4294967296 list double #".split(b" "), b"", b"\n", b"\xff")
"""Words that replace a word of a text."""


def mutate_bytes(draw: random.Random, data: bytes) -> bytes:
    """Make one to four changes: to bits, bytes or numbers, or pieces removed, doubled, moved or inserted."""
    made = bytearray(data)
    for _ in range(draw.choice((1, 1, 1, 2, 4))):
        size = len(made)
        at = draw.randrange(size + 1)
        kind = draw.randrange(9)
        if kind < 2 and size:
            made[at % size] ^= 1 << draw.randrange(8)
        elif kind == 2 and size:
            made[at % size] = draw.randrange(256)
        elif kind == 3 and size >= 4:
            struct.pack_into("<I", made, draw.randrange(size - 3), draw.choice(NUMBERS))
        elif kind == 4 and size >= 8:
            struct.pack_into("<Q", made, draw.randrange(size - 7), draw.choice(NUMBERS) << draw.choice((0, 32)))
        elif kind == 5:
            del made[at : at + draw.choice((1, 4, 16, 256))]
        elif kind == 6:
            made[at:at] = draw.randbytes(draw.choice((1, 2, 4, 64)))
        elif kind == 7:
            other = draw.randrange(size + 1)
            made[at:at] = made[other : other + draw.choice((1, 8, 64))]
        else:
            del made[at:]
    return bytes(made)


def mutate_sparse(draw: random.Random, data: bytes) -> bytes:
    """Change any bytes, but most often some around a byte that is not zero, of the first ones half of the time.

    For files with large headers that are nearly empty.
    """
    if draw.random() < 0.3:
        return mutate_bytes(draw, data)
    places = [at for at, byte in enumerate(data) if byte]
    at = draw.choice(places[: draw.choice((48, len(places)))])
    start, stop = max(0, at - 4), at + 12
    return data[:start] + _same_size(draw, data[start:stop]) + data[stop:]


def mutate_spz(draw: random.Random, data: bytes) -> bytes:
    """Change what a `.spz` holds once it is unpacked, and pack it again: its first bytes half of the time."""
    if data.startswith(b"NGSP"):
        return _mutate_frames(draw, data)
    inner = gzip.decompress(data)
    if draw.random() < 0.5:
        return gzip.compress(_same_size(draw, inner[:16]) + inner[16:], 1)
    return gzip.compress(mutate_bytes(draw, inner), 1)


def _mutate_frames(draw: random.Random, data: bytes) -> bytes:
    """Change the content of one frame of version 4, and correct its sizes in the table; or the header and the table."""
    place, count = struct.unpack_from("<I", data, 16)[0], data[15]
    if draw.random() < 0.5:
        end = place + 16 * count
        return _same_size(draw, data[:end]) + data[end:]
    at, chosen, table, frames = place + 16 * count, draw.randrange(count), b"", b""
    for index in range(count):
        packed, size = struct.unpack_from("<QQ", data, place + 16 * index)
        frame = data[at : at + packed]
        if index == chosen:
            content = mutate_bytes(draw, zstandard.ZstdDecompressor().decompress(frame))
            frame = zstandard.ZstdCompressor().compress(content)
            size = draw.choice((size, len(content)))
        table += struct.pack("<QQ", len(frame), size)
        frames += frame
        at += packed
    return data[:place] + table + frames


def mutate_text(draw: random.Random, data: bytes) -> bytes:
    """Replace, move or double words and lines of a text (or of a PLY's header), or change any bytes."""
    if draw.random() < 0.3:
        return mutate_bytes(draw, data)
    end = data.find(b"end_header\n")
    text, rest = (data[: end + 11], data[end + 11 :]) if end >= 0 else (data, b"")
    pieces = re.split(rb"(\s+|,|:)", text)
    for _ in range(draw.choice((1, 1, 2, 5))):
        at = draw.randrange(len(pieces))
        if draw.random() < 0.6:
            pieces[at] = draw.choice(WORDS)
        else:
            pieces[at:at] = pieces[(other := draw.randrange(len(pieces))) : other + draw.choice((1, 2, 8))]
    return b"".join(pieces) + rest


def mutate_json(draw: random.Random, data: bytes) -> bytes:
    """Replace one value of a JSON text or drop a key, or change its text."""
    if draw.random() < 0.4:
        return mutate_text(draw, data)
    record = json.loads(data)
    places: list[tuple[dict[str, object] | list[object], str | int]] = []

    def walk(value: object) -> None:
        inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
        for key, below in inner:
            places.append((value, key))  # type: ignore[arg-type]
            walk(below)

    walk(record)
    for _ in range(draw.choice((1, 1, 2))):
        parent, key = draw.choice(places)
        try:
            if draw.random() < 0.2:
                del parent[key]  # type: ignore[arg-type]
            else:
                parent[key] = draw.choice(VALUES)  # type: ignore[index]
        except (KeyError, IndexError):
            continue  # an earlier change removed it
    return json.dumps(record).encode()


def mutate_glb(draw: random.Random, data: bytes) -> bytes:
    """Change the JSON or the buffer of a `.glb`, and correct the lengths of its chunks."""
    size = struct.unpack_from("<I", data, 12)[0]
    text, buffer = data[20 : 20 + size], data[28 + size :]
    if draw.random() < 0.7:
        text = mutate_json(draw, text)
    else:
        buffer = mutate_bytes(draw, buffer)
    text, buffer = text + b" " * (-len(text) % 4), buffer + b"\0" * (-len(buffer) % 4)
    head = struct.pack("<4I", 2, 28 + len(text) + len(buffer), len(text), 0x4E4F534A)
    return b"glTF" + head + text + struct.pack("<2I", len(buffer), 0x004E4942) + buffer


def mutate_zipped_json(draw: random.Random, data: bytes) -> bytes:
    """Change the JSON text of a zip, and pack it again with the right checksums."""
    return _repacked(data, lambda names: next(name for name in names if name.endswith(".json")), mutate_json, draw)


def mutate_zipped_piece(draw: random.Random, data: bytes) -> bytes:
    """Change the bytes of a file of a zip that is no JSON text, and pack it again with the right checksums."""
    return _repacked(
        data, lambda names: draw.choice([name for name in names if not name.endswith(".json")]), mutate_bytes, draw
    )


def _repacked(
    data: bytes,
    choose: Callable[[list[str]], str],
    mutate: Callable[[random.Random, bytes], bytes],
    draw: random.Random,
) -> bytes:
    place = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as old, zipfile.ZipFile(place, "w") as new:
        chosen = choose(old.namelist())
        for info in old.infolist():
            piece = old.read(info)
            new.writestr(zipfile.ZipInfo(info.filename), mutate(draw, piece) if info.filename == chosen else piece)
    return place.getvalue()


def mutate_sealed(draw: random.Random, data: bytes, sections: Sequence[Section]) -> bytes:
    """Change a container's header, ranges, model, chunks or chunk table, and correct all checksums.

    `sections` are those of `data`.
    """
    section = draw.choice(sections[1:])
    if section.name == "header":
        block = data[section.offset : section.offset + section.length]
        text = mutate_json(draw, block.rstrip())
        # Version 1 pads its header to whole steps.
        text = text.ljust(-(-len(text) // HEADER_STEP) * HEADER_STEP) if data[8] == 1 else text
        return _seal(data[: section.offset] + text + data[section.offset + section.length :], len(text))
    made = bytearray(data)
    if section.name.startswith("chunk ") and section.name != "chunk table":
        body = _same_size(draw, data[section.offset : section.offset + section.length])
        made[section.offset : section.offset + section.length] = body
        table = sections[-1]
        struct.pack_into("<I", made, table.offset + 8 * int(section.name[6:]) + 4, zlib.crc32(body))
        _sum_behind(made, table)
    else:
        body = _same_size(draw, data[section.offset : section.offset + section.length - 4])
        made[section.offset : section.offset + len(body)] = body
        _sum_behind(made, section)
    return bytes(made)


def mutate_preview(draw: random.Random, data: bytes, sections: Sequence[Section]) -> bytes:
    """Change the preview of a container, which is a container too, and correct all checksums.

    `sections` are those of `data`.
    """
    header, part = (next(each for each in sections if each.name == name) for name in ("header", "preview"))
    inner = data[part.offset : part.offset + part.length]
    changed = mutate_sealed(draw, inner, _sections_of(inner))
    key = b'"preview_bytes":'
    text = data[header.offset : header.offset + header.length].replace(
        key + b"%d" % part.length, key + b"%d" % len(changed)
    )
    behind = data[header.offset + header.length : part.offset]
    return _seal(data[: header.offset] + text + behind + changed + data[part.offset + part.length :], len(text))


@functools.cache
def _sections_of(container: bytes) -> tuple[Section, ...]:
    with tempfile.NamedTemporaryFile(suffix=".fgs") as file:
        file.write(container)
        file.flush()
        return tuple(verify(file.name))


def _same_size(draw: random.Random, body: bytes) -> bytes:
    return mutate_bytes(draw, body)[: len(body)].ljust(len(body), draw.choice((b"\0", b"\xff")))


def _sum_behind(data: bytearray, section: Section) -> None:
    """The checksum at a section's end."""
    end = section.offset + section.length - 4
    struct.pack_into("<I", data, end, zlib.crc32(data[section.offset : end]))


def _seal(data: bytes, length: int) -> bytes:
    """`data` with its file size, header checksum and preamble checksum corrected."""
    made = bytearray(data)
    struct.pack_into("<QII", made, 16, len(made), length, zlib.crc32(made[36 : 36 + length]))
    struct.pack_into("<I", made, 32, zlib.crc32(made[:32]))
    return bytes(made)
