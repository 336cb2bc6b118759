"""The frame of `.fgs` files of both versions: a preamble, sections that end in a checksum, and chunks listed in a table.

Headers are strict JSON. What both versions check in them stands here too.

Every byte lies under a checksum, or has only one allowed value. We allocate nothing for sizes in a header before they
agree with the size of the file.
"""

import json
import math
import os
import struct
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TypeVar

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.scene.contraction import LARGEST, Contraction

MAGIC = b"\x93FGS\r\n\x1a\n"
"""First bytes of a file: a byte above 127, both line ends and a text stop (the idea of PNG). A transfer as text breaks
them."""
_PREAMBLE = struct.Struct("<8sHHIQII")
_U32 = struct.Struct("<I")
_PIECE = 1 << 20  # Bytes read at a time to compute a checksum

_Header = TypeVar("_Header")
PREAMBLE_BYTES = 36
MAX_COUNT = 2**32 - 1


class HeaderError(ValueError):
    """A header that breaks the format; the message tells what was wanted and what was found."""


@dataclass(frozen=True)
class Section:
    """A part of the file with its own checksum."""

    name: str
    offset: int
    length: int
    ok: bool = True


def canonical_json(value: object) -> bytes:
    """Encode a value as JSON with sorted keys, without spaces, in ASCII, and without NaN or infinity."""
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"settings: expected JSON values with text keys and finite numbers: {error}") from None
    return text.encode("ascii")


def parse_json(block: bytes) -> object:
    """Decode JSON without repeated keys, NaN or infinity; raises `HeaderError`."""
    try:
        return json.loads(block.decode("ascii"), object_pairs_hook=_unique, parse_constant=_no_constant)
    except HeaderError:
        raise
    except RecursionError:
        raise HeaderError("wanted JSON, got values nested too deep") from None
    except ValueError as error:  # also for bytes beyond ASCII, and for numbers of absurd length
        raise HeaderError(f"wanted JSON in ASCII, got {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) != len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise HeaderError(f"wanted each key once, got {brief(twice)} twice")
    return record


def _no_constant(text: str) -> NoReturn:
    raise HeaderError(f"wanted finite numbers, got {text}")


def checked_integer(name: str, value: object, lowest: int, highest: int) -> int:
    """Check an integer of a header against its bounds; raises `HeaderError`."""
    # bool is a subclass of int, and `true` must not pass as 1.
    if type(value) is not int or not lowest <= value <= highest:
        raise HeaderError(f"{name}: wanted an integer from {lowest} to {highest}, got {shown(value)}")
    return value


def checked_origin(value: object) -> tuple[float, float, float]:
    """Check three finite numbers of a header; raises `HeaderError`."""
    if isinstance(value, list) and len(value) == 3 and all(type(v) is float and math.isfinite(v) for v in value):
        return (value[0], value[1], value[2])
    raise HeaderError(f"origin: wanted three finite numbers with a decimal point, got {shown(value)}")


def checked_contraction(value: object) -> Contraction:
    """Check the contraction of a header; raises `HeaderError`."""
    if isinstance(value, dict) and sorted(value) == ["centre", "radius"] and isinstance(value["centre"], list):
        numbers = [*value["centre"], value["radius"]]
        known = len(numbers) == 4 and all(type(number) is float and abs(number) <= LARGEST for number in numbers)
        if known and value["radius"] >= 1 / LARGEST:
            return Contraction.from_json(value)
    raise HeaderError(
        "contraction: wanted an object with centre (three numbers with a decimal point, within +-2^126) and radius (2^-126 to "
        f"2^126), got {shown(value)}"
    )


def shown(value: object) -> str:
    """A value for an error message, shortened."""
    return "an integer of more than 40 digits" if isinstance(value, int) and abs(value) >= 10**40 else brief(value)


def format_error(path: object, offset: int, message: str) -> FormatError:
    """The error for wrong bytes in a file; all such messages begin with the file and the byte."""
    return FormatError(f"{path}: byte {offset}: {message}")


@dataclass(frozen=True)
class ChunkEntry:
    """The place and checksum of a chunk."""

    section: Section
    checksum: int


def checked(data: bytes) -> bytes:
    """Append the checksum to data."""
    return data + _U32.pack(zlib.crc32(data))


def preamble(version: int, size: int, block: bytes) -> bytes:
    """The preamble of a file of `size` bytes with the header `block`."""
    return checked(_PREAMBLE.pack(MAGIC, version, 0, 0, size, len(block), zlib.crc32(block)))


class SectionFile:
    """A `.fgs` file of one version. `path`: the file is opened for each read, and never held open."""

    version: int

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)

    @contextmanager
    def open(self) -> Iterator[BinaryIO]:
        """Open the file for reading; raises `InputError`."""
        with ExitStack() as stack:
            try:
                file = stack.enter_context(open(self.path, "rb"))
            except OSError as error:
                raise InputError(f"{self.path}: cannot read it ({error.strerror})") from error
            yield file

    def read_section(self, file: BinaryIO, section: Section) -> bytes:
        """Read a section and check it; returns its bytes without the checksum at the end."""
        file.seek(section.offset)
        data = self._read(file, section.length, section.name)
        self._compare(section, _U32.unpack_from(data, section.length - 4)[0], zlib.crc32(memoryview(data)[:-4]))
        return data[:-4]

    def read_chunk(self, entry: ChunkEntry) -> bytes:
        """Read and check a chunk."""
        section = entry.section
        with self.open() as file:
            file.seek(section.offset)
            data = self._read(file, section.length, section.name)
        self._compare(section, entry.checksum, zlib.crc32(data))
        return data

    def check_chunk(self, entry: ChunkEntry) -> None:
        """Check a chunk in pieces, without holding it in memory."""
        with self.open() as file:
            self.copy_chunk(file, entry, None)

    def copy_chunk(self, file: BinaryIO, entry: ChunkEntry, out: BinaryIO | None) -> None:
        """Copy a chunk in pieces, and check it."""
        left, checksum = entry.section.length, 0
        file.seek(entry.section.offset)
        while left:
            piece = self._read(file, min(left, _PIECE), entry.section.name)
            checksum = zlib.crc32(piece, checksum)
            left -= len(piece)
            if out is not None:
                out.write(piece)
        self._compare(entry.section, entry.checksum, checksum)

    def _read_header(
        self,
        file: BinaryIO,
        size: int,
        wrong_length: Callable[[int, int], str],
        decode: Callable[[bytes], _Header],  # makes a header from its bytes; raises `HeaderError`
    ) -> _Header:
        """Read and check the header of a file of `size` bytes.

        `wrong_length`: the fault of a header's length, given the room for it; "" if there is none.
        """
        start = self._read(file, PREAMBLE_BYTES, "preamble")
        magic, version, required, _, claimed, block_bytes, block_sum = _PREAMBLE.unpack_from(start)
        if magic != MAGIC:
            raise self._error(0, f"magic: wanted {MAGIC!r}, got {magic!r}: not a .fgs file, or damaged")
        if version != self.version:
            raise self._error(
                8, f"version: wanted {self.version}, got {version}: another program wrote it, or it is damaged"
            )
        self._compare(Section("preamble", 0, 0), _U32.unpack_from(start, 32)[0], zlib.crc32(start[:32]))
        if required:
            raise self._error(
                10, f"flags that must be understood: wanted 0, got {required:#x}: a newer program wrote it"
            )
        if claimed != size:
            raise self._error(16, f"file size: wanted {claimed}, got {size}: truncated or extended")
        if wrong := wrong_length(block_bytes, size - PREAMBLE_BYTES):
            raise self._error(24, f"header length: {wrong}, got {block_bytes}")
        block = self._read(file, block_bytes, "header")
        self._compare(Section("header", PREAMBLE_BYTES, 0), block_sum, zlib.crc32(block))
        try:
            return decode(block)
        except HeaderError as error:
            raise self._error(PREAMBLE_BYTES, f"header: {error}") from None

    def _read(self, file: BinaryIO, length: int, name: str) -> bytes:
        offset = file.tell()
        data = file.read(length)
        if len(data) != length:
            raise self._error(offset, f"{name}: wanted {length} bytes, got {len(data)}: the file is truncated")
        return data

    def _compare(self, section: Section, wanted: int, got: int) -> None:
        if wanted != got:
            raise self._error(
                section.offset, f"{section.name}: checksum: wanted {wanted:08x}, got {got:08x}: the file is damaged"
            )

    def _error(self, offset: int, message: str) -> FormatError:
        return format_error(self.path, offset, message)


class Verification:
    """Collects the sections of a file, each with the result of its check.

    `block`: bytes of the header, which has been read. `raise_errors`: if False, report damage as `ok=False` instead of
    raising an error.
    """

    def __init__(self, block: int, raise_errors: bool) -> None:
        self.raise_errors = raise_errors
        self._sections = [Section("preamble", 0, PREAMBLE_BYTES), Section("header", PREAMBLE_BYTES, block)]

    def check(self, section: Section, test: Callable[[], object]) -> bool:
        """Add a section, and return whether `test` passes."""
        try:
            test()
        except FormatError:
            if self.raise_errors:
                raise
            self._sections.append(replace(section, ok=False))
            return False
        self._sections.append(section)
        return True

    def check_chunks(
        self, file: SectionFile, table: Section, read: Callable[[], list[ChunkEntry]], unknown: Iterable[Section]
    ) -> list[Section]:
        """Check the chunk table and the chunks.

        It returns all sections in file order, with `unknown` if the table is damaged.
        """
        if self.check(table, read):
            for entry in read():
                self.check(entry.section, partial(file.check_chunk, entry))
        else:
            self._sections += [replace(section, ok=False) for section in unknown]
        return sorted(self._sections, key=lambda section: section.offset)
