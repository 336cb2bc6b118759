"""The layout of `.spz` files (Niantic Labs), versions 1 to 4, and the reader.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then one array for each attribute. Version 4 has a plain
header of 32 bytes, extensions, a table of sizes, and one zstd frame for each array. All numbers are little endian.
"""

import io
import os
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import FormatError
from flexgs_edge.io.codes import rest_of_unit, with_largest
from flexgs_edge.io.decoded import DecodedSource, opacity_logits
from flexgs_edge.io.frames import Frame
from flexgs_edge.io.kinds import GZIP_MAGIC
from flexgs_edge.io.reading import AS_WRITTEN, Reading
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Rows

_BLOCK = 1 << 18  # Packed bytes read at a time
_PIECE = 1 << 20  # Unpacked bytes asked for at a time
_TAIL = 1 << 20  # Most bytes behind the arrays; extensions have a few
_MOST_PACKED = 1032
"""Bytes that one byte can unpack to: what deflate reaches. Version 4 has the same limit, as in the reference program."""
MAGIC = b"NGSP"
HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, count, SH degree, bits behind the point, flags; then a zero, or in version 4 the number of arrays."""
PLAIN_HEADER = struct.Struct("<4sIIBBBBI12x")  # Header of version 4: also the place of the table of sizes
SIZES = struct.Struct("<QQ")  # Entry of the table: packed and unpacked bytes of an array
ANTIALIASED, EXTENDED = 1, 2  # Flags
VERSIONS = range(1, 5)
FIRST_PLAIN = 4  # First version with a plain header
POSITION_LIMIT = (1 << 23) - 1  # Largest code of a coordinate: 24 bits with a sign
MAX_FRACTION_BITS = 30  # Readers compute 1 << bits in 32 bits with a sign
COLOUR_SCALE = 0.15  # Colour codes are 0.5 + 0.15 times the coefficient, so that they reach beyond black and white
SCALE_OFFSET, SCALE_STEPS = 10.0, 16.0  # Codes of log-scales: 16 a unit, from -10 on
ROTATION_MASK = (1 << 9) - 1
"""Magnitude of a quaternion's component from version 3 on: 9 bits for up to the root of 1/2."""
_COORDINATES = 0xADBE0003  # Type of the extension that states the frame
_FRAMES = tuple(a + b + c for b, c in ("DB", "UB", "DF", "UF", "FD", "FU", "BD", "BU") for a in "LR")
"""Frames by their number in that extension, from 1 on; 0 says nothing. From 9 on, y and z are exchanged."""
_SHOWN = 4


@dataclass(frozen=True)
class SpzHeader:
    """A checked header."""

    version: int  # 1 to 4
    count: int  # Gaussians
    sh_degree: int  # 0 to 4
    fraction_bits: int  # bits behind the point of coordinates; version 1 has none
    flags: int = 0  # bits; see `ANTIALIASED` and `EXTENDED`

    @property
    def widths(self) -> dict[str, int]:
        """Bytes of a Gaussian by field, in the order of the arrays; fields without bytes are left out."""
        widths = {
            "means": 6 if self.version == 1 else 9,
            "opacity_logits": 1,
            "sh_dc": 3,
            "log_scales": 3,
            "quats": 3 if self.version < 3 else 4,
            "sh_rest": 3 * sh_rest_count(self.sh_degree),
        }
        return {field: width for field, width in widths.items() if width}

    @property
    def row_bytes(self) -> int:
        """Bytes of a Gaussian, unpacked."""
        return sum(self.widths.values())

    @property
    def packed(self) -> bytes:
        """The header of versions 1 to 3."""
        return HEADER.pack(MAGIC, self.version, self.count, self.sh_degree, self.fraction_bits, self.flags, 0)


def parse_header(name: str, head: bytes) -> SpzHeader:
    """Check the first 16 bytes of an unpacked stream, or of version 4.

    Raises `FormatError` if a field is not as the format has it.
    """
    if len(head) < HEADER.size:
        raise FormatError(f"{name}: truncated: expected a header of {HEADER.size} bytes, found {len(head)}")
    _, version, count, degree, bits, flags, _ = HEADER.unpack_from(head)
    if version not in VERSIONS:
        raise FormatError(f"{name}: byte 4, version: expected 1 to {VERSIONS[-1]}, found {version}")
    if degree > MAX_SH_DEGREE:
        raise FormatError(f"{name}: byte 12, SH degree: expected 0 to {MAX_SH_DEGREE}, found {degree}")
    if version > 1 and bits > MAX_FRACTION_BITS:
        raise FormatError(f"{name}: byte 13, bits behind the point: expected 0 to {MAX_FRACTION_BITS}, found {bits}")
    return SpzHeader(version, count, degree, bits, flags)


def parse_extensions(name: str, block: bytes, asked: Frame | None) -> tuple[Frame | None, tuple[str, ...]]:
    """Find the frame that extensions state, and notes on those that are left out.

    `block`: records of type (u32), length (u32) and content. `asked`: the user's frame: what the file says of it then
    does not matter. Raises `FormatError` if the stated frame is unknown or not one of ours.
    """
    frame, others, at = None, dict[str, None](), 0
    while at + 8 <= len(block):
        kind, length = struct.unpack_from("<II", block, at)
        if kind == 0 or length > len(block) - at - 8:
            break
        if kind == _COORDINATES and length >= 4:
            frame = _frame(name, struct.unpack_from("<I", block, at + 8)[0], asked)
        else:
            others[f"0x{kind:08X}"] = None
        at += 8 + length
    notes = []
    if others:
        more = f" and {len(others) - _SHOWN} more" if len(others) > _SHOWN else ""
        notes.append(f"extensions left out: {', '.join(list(others)[:_SHOWN])}{more}")
    if at < len(block):
        notes.append(f"{len(block) - at} bytes of extensions are not understood and left out")
    return frame, tuple(notes)


def _frame(name: str, number: int, asked: Frame | None) -> Frame | None:
    if number == 0 or asked is not None:
        return None
    if number > len(_FRAMES):
        raise FormatError(
            f"{name}: extension coordinate system: expected 0 to {len(_FRAMES)}, found {number}; "
            "name the axes by --frame"
        )
    letters = _FRAMES[number - 1]
    if number > 8:
        raise FormatError(
            f"{name}: extension coordinate system: {letters} exchanges y and z, which is not supported; "
            "convert the file to RUB with the program that wrote it"
        )
    return Frame(letters)


class SpzSource(DecodedSource):
    """A `.spz`: its codes, decoded when they are read.

    `name`: the user's path, for messages. `header`: what the file says. `arrays`: [bytes] u8 each, unpacked, in the
    order of `header.widths`. `frame`: the frame that the file states. `notes`: on what was left out.
    """

    def __init__(
        self, name: str, header: SpzHeader, arrays: list[np.ndarray], frame: Frame | None, notes: tuple[str, ...]
    ) -> None:
        super().__init__(name, header.count, header.sh_degree, sum(array.nbytes for array in arrays))
        self.header, self.frame, self.notes = header, frame, notes
        self.version = header.version
        if header.flags & ANTIALIASED:
            self.settings = {"antialiased": True}
        self._codes = {
            field: array.reshape(header.count, width)
            for array, (field, width) in zip(arrays, header.widths.items(), strict=True)
        }

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        codes = self._codes[field][rows]
        if field == "means":
            return _positions(codes, self.header)
        if field == "opacity_logits":
            return opacity_logits(codes.T / 255.0)
        if field == "sh_dc":
            return (codes.T / 255.0 - 0.5) / COLOUR_SCALE
        if field == "log_scales":
            return codes.T / SCALE_STEPS - SCALE_OFFSET
        if field == "quats":
            return _first_three(codes) if codes.shape[1] == 3 else _smallest_three(codes)
        # Colour channels vary fastest in the file, and slowest here.
        turned = codes.reshape(len(codes), -1, 3).transpose(2, 1, 0).reshape(codes.shape[1], -1)
        return (turned - np.float32(128)) / np.float32(128)


def read_spz(path: Path, name: str, reading: Reading) -> SpzSource:
    """Open a `.spz`; see `Format.reader`.

    Raises `FormatError` if the file breaks the format or unpacks to more than its header says.
    """
    with open(path, "rb") as file:
        return parse_spz(file, name, reading)


def spz_source(data: bytes, name: str) -> SpzSource:
    """Read a `.spz` that is a part of another file; messages call it `name`."""
    return parse_spz(io.BytesIO(data), name)


def parse_spz(file: BinaryIO, name: str, reading: Reading = AS_WRITTEN) -> SpzSource:
    """Read a `.spz` from an open file."""
    size = file.seek(0, os.SEEK_END)
    file.seek(0)
    head = file.read(HEADER.size)
    file.seek(0)
    if head.startswith(GZIP_MAGIC):
        return _one_stream(_Gunzip(file, name), size * _MOST_PACKED, name, reading, ())
    if not head.startswith(MAGIC):
        raise FormatError(
            f"{name}: not a .spz: expected the bytes of gzip (versions 1 to 3) or {MAGIC!r} (version 4) at byte 0; "
            f"found {head[:8]!r}"
        )
    if parse_header(name, head).version >= FIRST_PLAIN:
        return _packed_arrays(file, size, name, reading)
    note = "not packed by gzip, against the specification; read as it is"
    return _one_stream(_Plain(file), size, name, reading, (note,))


class _Plain:
    """A stream that lacks its gzip layer."""

    behind = 0

    def __init__(self, file: BinaryIO) -> None:
        self.read = file.read

    def check_end(self) -> None:
        """Nothing tells where it ends."""


class _Gunzip:
    """A gzip stream, unpacked only as far as it is read."""

    def __init__(self, file: BinaryIO, name: str) -> None:
        self.file, self.name = file, name
        self._stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
        self._done = 0

    @property
    def behind(self) -> int:
        """Bytes of the file behind the stream; known when the stream has ended."""
        at = self.file.tell()
        return len(self._stream.unused_data) + self.file.seek(0, os.SEEK_END) - at

    def read(self, size: int) -> bytes:
        """The next bytes; fewer than `size` only at the end."""
        found = bytearray()
        while len(found) < size and not self._stream.eof:
            packed = self._stream.unconsumed_tail or self.file.read(_BLOCK)
            try:
                piece = self._stream.decompress(packed, size - len(found))
            except zlib.error as error:
                raise FormatError(
                    f"{self.name}: damaged: gzip fails after {self._done} unpacked bytes ({error})"
                ) from error
            if not piece and not packed:
                break
            found += piece
            self._done += len(piece)
        return bytes(found)

    def check_end(self) -> None:
        """Raise `FormatError` if the file ends before the stream."""
        if not self._stream.eof:
            raise FormatError(
                f"{self.name}: truncated: the gzip stream has no end after {self._done} unpacked bytes; "
                "is the file complete?"
            )


def _gathered(read: Callable[[int], bytes], size: int) -> np.ndarray:
    """[at most `size`] u8; memory is taken as bytes arrive, since a claim may be false."""
    found = bytearray()
    while len(found) < size and (piece := read(min(size - len(found), _PIECE))):
        found += piece
    return np.frombuffer(found, np.uint8)


def _one_stream(stream: _Plain | _Gunzip, most: int, name: str, reading: Reading, notes: tuple[str, ...]) -> SpzSource:
    """Versions 1 to 3; `most` is what the file's size allows, unpacked."""
    head = stream.read(HEADER.size)
    if head[:4] != MAGIC:
        raise FormatError(
            f"{name}: not a .spz: expected {MAGIC!r} at the start of the unpacked data, found {head[:8]!r}"
        )
    header = parse_header(name, head)
    wanted = header.count * header.row_bytes
    _check_claim(name, header, most - HEADER.size, wanted)
    reading.require(name, wanted + _TAIL)
    data = _gathered(stream.read, wanted)
    if len(data) < wanted:
        raise FormatError(f"{name}: truncated: {_claim(header, wanted)}; found {len(data)}; is the file complete?")
    tail = stream.read(_TAIL)
    if len(tail) == _TAIL:
        raise FormatError(f"{name}: {_claim(header, wanted)}; more than {_TAIL} bytes follow")
    stream.check_end()
    frame = None
    if header.flags & EXTENDED:
        frame, left_out = parse_extensions(name, tail, reading.frame)
        notes, tail = notes + left_out, b""
    ignored = len(tail) + stream.behind
    cuts = header.count * np.cumsum(list(header.widths.values()))[:-1]
    return SpzSource(name, header, np.split(data, cuts), frame, notes + _ignored(ignored))


def _packed_arrays(file: BinaryIO, size: int, name: str, reading: Reading) -> SpzSource:
    """Version 4."""
    if size < PLAIN_HEADER.size:
        raise FormatError(f"{name}: truncated: expected a header of {PLAIN_HEADER.size} bytes, found {size}")
    head = file.read(PLAIN_HEADER.size)
    header = parse_header(name, head)
    *_, arrays, place = PLAIN_HEADER.unpack(head)
    widths = header.widths
    wanted = header.count * header.row_bytes
    # Files without Gaussians have no arrays at all.
    if arrays != (len(widths) if header.count else 0):
        raise FormatError(f"{name}: byte 15, number of arrays: expected {len(widths)}, found {arrays}")
    if not header.count:
        return SpzSource(name, header, [np.zeros(0, np.uint8)] * len(widths), None, ())
    end = place + arrays * SIZES.size
    if not PLAIN_HEADER.size <= place <= end <= size:
        raise FormatError(
            f"{name}: byte 16, place of the table: expected {PLAIN_HEADER.size} to {size - arrays * SIZES.size}, "
            f"found {place}; is the file complete?"
        )
    _check_claim(name, header, size * _MOST_PACKED, wanted)
    reading.require(name, size + wanted)
    extensions = file.read(place - PLAIN_HEADER.size) if header.flags & EXTENDED else b""
    frame, notes = parse_extensions(name, extensions, reading.frame)
    file.seek(place)
    table = list(SIZES.iter_unpack(file.read(arrays * SIZES.size)))
    left = size - end
    for index, ((packed, unpacked), (field, width)) in enumerate(zip(table, widths.items(), strict=True)):
        if unpacked != width * header.count:
            raise FormatError(
                f"{name}: byte {place + index * SIZES.size + 8}, size of {field}: expected {width * header.count} bytes, "
                f"found {unpacked}"
            )
        if packed > left:
            raise FormatError(
                f"{name}: truncated: the table promises {packed} bytes of {field}; found {left}; is the file complete?"
            )
        left -= packed
    parts = [
        _unzstd(name, field, file.read(packed), unpacked)
        for (packed, unpacked), field in zip(table, widths, strict=True)
    ]
    return SpzSource(name, header, parts, frame, notes + _ignored(left))


def _unzstd(name: str, field: str, packed: bytes, size: int) -> np.ndarray:
    """[size] u8, the content of one zstd frame."""
    try:
        reader = zstandard.ZstdDecompressor().stream_reader(packed)
        found = _gathered(reader.read, size)
        more = reader.read(1)
    except zstandard.ZstdError as error:
        raise FormatError(f"{name}: damaged: the zstd frame of {field} does not unpack ({error})") from error
    if len(found) < size or more:
        holds = f"more than {size}" if more else f"{len(found)}"
        raise FormatError(f"{name}: {field}: expected {size} bytes, the zstd frame holds {holds}")
    return found


def _claim(header: SpzHeader, wanted: int) -> str:
    return f"the header promises {header.count} Gaussians of SH degree {header.sh_degree}, {wanted} bytes"


def _check_claim(name: str, header: SpzHeader, most: int, wanted: int) -> None:
    if wanted > most:
        raise FormatError(
            f"{name}: truncated: {_claim(header, wanted)}; a file of this size can hold {max(most, 0)} at most; "
            "is it complete?"
        )


def _ignored(size: int) -> tuple[str, ...]:
    return (f"{size} bytes behind the data ignored",) if size else ()


def _positions(codes: np.ndarray, header: SpzHeader) -> np.ndarray:
    """[3, n]: float16 in version 1, else integers of 24 bits with a sign."""
    if header.version == 1:
        return np.ascontiguousarray(codes).view("<f2").T.astype(np.float32)
    parts = codes.reshape(len(codes), 3, 3).astype(np.int32)
    # The third byte is shifted to the top and back, so that its sign fills the word.
    fixed = parts[..., 0] | (parts[..., 1] << 8) | ((parts[..., 2] << 24) >> 8)
    return np.ldexp(fixed.T.astype(np.float32), -header.fraction_bits)


def _first_three(codes: np.ndarray) -> np.ndarray:
    """[4, n] w x y z of versions 1 and 2: x, y and z are stored, and w is not negative."""
    axis = codes.T / 127.5 - 1
    return np.concatenate([rest_of_unit(axis), axis])


def _smallest_three(codes: np.ndarray) -> np.ndarray:
    """[4, n] w x y z from version 3 on: all but the largest are stored, in the order x y z w."""
    words = np.ascontiguousarray(codes).view("<u4")[:, 0]
    largest = (words >> 30).astype(np.int64)
    smaller = np.empty((3, len(words)))
    for place in range(3):
        part = (words >> np.uint32(10 * (2 - place))) & np.uint32(2 * ROTATION_MASK + 1)
        size = (part & ROTATION_MASK) * (np.sqrt(0.5) / ROTATION_MASK)
        smaller[place] = np.where(part > ROTATION_MASK, -size, size)
    return with_largest(largest, smaller)[[3, 0, 1, 2]]
