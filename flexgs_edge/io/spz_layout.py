"""The layout of `.spz` files (Niantic Labs), for the reader and the writer: headers, arrays, extensions.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then one array for each attribute. Version 4 has a plain
header of 32 bytes, extensions, a table of sizes, and one zstd frame for each array. All numbers are little endian.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import FormatError
from flexgs_edge.io.frames import Frame
from flexgs_edge.scene.fields import sh_rest_count

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
