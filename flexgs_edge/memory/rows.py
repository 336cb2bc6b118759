"""Rows of arrays that may lie in mapped files: read from the kernel's cache or past it, and written without their pages."""

from __future__ import annotations

import mmap
import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property, partial
from typing import Any, BinaryIO, Protocol

import numpy as np

from flexgs_edge.memory.direct import BUFFER_BYTES, DirectFile, is_cached

BLOCK_ROWS = 1 << 14
"""Rows at a time of what is done row by row: 24 MB of all fields in double precision, with the copies that NumPy makes."""
AHEAD_ROWS = 1 << 15
"""Rows that are read ahead at a time."""
COPY_ROWS = 1 << 18
"""Rows of one plane at a time: a megabyte."""
DENSE = 4
"""Rows read for one that is wanted, at most: rather than page by page."""
READERS = 4
"""Threads that read past the cache. One alone does not keep a disk busy: docs/results/tuning.md#disks"""
_READING = ThreadPoolExecutor(READERS, "read")
_TAKING = ThreadPoolExecutor(2, "take")
"""Planes at a time of which rows are taken: while one is read or written, the other is looked up in."""
READING_BYTES = (READERS + 4) * BUFFER_BYTES
"""Buffers of these threads, and of those that take planes, load chunks or read ahead."""
_Piece = tuple[DirectFile, int, memoryview]
"""A file, a byte of it, and what to fill from there on."""


class _Owner(Protocol):
    """Whose file it is."""

    used: int
    """Bytes of its mapped files."""

    def full(self, size: int, error: OSError) -> Exception:
        """What to raise when `size` bytes cannot be had."""


class MappedFile(mmap.mmap):
    """A mapped file that counts itself."""

    storage: _Owner
    address: int
    file: BinaryIO

    @cached_property
    def direct(self) -> DirectFile | None:
        """It, to be read past the cache."""
        return DirectFile.of(self.file)

    def __del__(self) -> None:
        self.storage.used -= len(self)
        direct = self.__dict__.get("direct")
        if direct is not None:
            direct.close()
        self.file.close()


def blocks(count: int, rows: int = BLOCK_ROWS) -> Iterator[slice]:
    """Parts of rows: their numbers in double precision, several copies of them, are held for a part at a time."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))


def fetch(values: np.ndarray, rows: slice) -> None:
    """Have the kernel read a part of every plane of a mapped array, all of it at once; nothing is done for one in memory.

    Parameters
    ----------
    values : np.ndarray
        [..., n].
    rows : slice
        `slice(start, stop)`.
    """
    held = map_of(values)
    if held is None or not hasattr(mmap, "MADV_WILLNEED"):
        return
    first, page = values.ctypes.data - held.address, mmap.PAGESIZE
    low, high = (values.strides[-1] * row for row in (rows.start, rows.stop))
    for place in np.ndindex(values.shape[:-1]):
        at = first + sum(number * stride for number, stride in zip(place, values.strides, strict=False))
        start, stop = (at + low) // page * page, at + high
        if stop > start:
            held.madvise(mmap.MADV_WILLNEED, start, stop - start)


def copy_rows(values: np.ndarray, rows: slice, out: np.ndarray) -> None:
    """`out[...] = values[..., rows]`; a mapped array is read from its file, while other threads go on.

    Parameters
    ----------
    values : np.ndarray
        [..., n], planes C-contiguous.
    rows : slice
        `slice(start, stop)`.
    out : np.ndarray
        [..., stop - start], of the same type.
    """
    copy_all_rows([(values, out)], rows)


def copy_all_rows(pairs: Iterable[tuple[np.ndarray, np.ndarray]], rows: slice) -> None:
    """`copy_rows` of several arrays and where they go, which the disk reads at a time."""
    missing = [piece for values, out in pairs for piece in _copy_cached(values, rows, out)]
    readers = min(READERS, len(missing))
    if readers < 2:
        _read_pieces(missing)
    else:
        for _ in _READING.map(_read_pieces, (missing[first::readers] for first in range(readers))):
            pass


def _read_pieces(pieces: Sequence[_Piece]) -> None:
    for file, at, out in pieces:
        file.read(at, out)


def _copy_cached(values: np.ndarray, rows: slice, out: np.ndarray) -> list[_Piece]:
    """`copy_rows` of what the kernel's cache holds, or of all where nothing else can be read; what is left."""
    held = map_of(values)
    if held is None or not hasattr(os, "preadv") or out.strides[-1] != out.itemsize:
        fetch(values, rows)
        out[...] = values[..., rows]
        return []
    missing, direct = [], held.direct
    for at, place in _planes(held, values, rows):
        left = out[place].data.cast("B")
        if direct is not None and not is_cached(held.address + at, len(left)):
            missing.append((direct, at, left))
            continue
        while left:
            size = os.preadv(held.file.fileno(), [left], at)
            if not size:
                raise EOFError(f"a scratch file ends at byte {at}")
            left, at = left[size:], at + size
    return missing


def read_rows(values: np.ndarray, rows: slice) -> np.ndarray:
    """`values[..., rows]`, not to be changed: a view of an array in memory, a copy of a mapped one."""
    if map_of(values) is None:
        return values[..., rows]
    out = np.empty((*values.shape[:-1], rows.stop - rows.start), values.dtype)
    copy_rows(values, rows, out)
    return out


def put_rows(values: np.ndarray, rows: slice, part: np.ndarray) -> None:
    """`values[..., rows] = part`; a mapped array is written to its file.

    Through mapped pages, each page would cost a fault of its own: docs/results/tuning.md#disks
    """
    held = map_of(values)
    if held is None or not hasattr(os, "pwrite"):
        values[..., rows] = part
        return
    shape = (*values.shape[:-1], rows.stop - rows.start)
    part = np.ascontiguousarray(np.broadcast_to(part, shape), values.dtype)
    for at, place in _planes(held, values, rows):
        left = part[place].data.cast("B")
        while left:
            try:
                size = os.pwrite(held.file.fileno(), left, at)
            except OSError as error:  # blocks are reserved; a disk that copies on writing may still be full
                raise held.storage.full(len(left), error) from error
            left, at = left[size:], at + size


def _planes(held: MappedFile, values: np.ndarray, rows: slice) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Of each plane of a mapped array: the byte of its file where some rows begin, and the plane's index."""
    first = values.ctypes.data - held.address + rows.start * values.itemsize
    for place in np.ndindex(values.shape[:-1]):
        yield first + sum(number * stride for number, stride in zip(place, values.strides, strict=False)), place


def take_rows(values: np.ndarray, rows: np.ndarray, out: np.ndarray, whole_bytes: int) -> None:
    """`out[...] = values[..., rows]`, rows being listed.

    `whole_bytes`: of a plane that memory may hold as a whole, two of them at a time.

    Of files, rows out of order are looked up in one plane at a time, or two, which memory holds where it cannot hold
    all. Going through all planes for every part of the rows would read the files many times:
    docs/results/tuning.md#disks
    """
    planes = [(values[place], out[place]) for place in np.ndindex(values.shape[:-1])]
    if not planes:
        return
    files = map_of(values) is not None or map_of(out) is not None
    each: Callable[..., Iterable[None]] = _TAKING.map if files else map

    def take_whole(plane: np.ndarray, taken: np.ndarray) -> None:
        whole = read_rows(plane, slice(0, plane.shape[-1]))
        for part in blocks(len(rows), COPY_ROWS):
            put_rows(taken, part, whole.take(read_rows(rows, part)))

    def take_part(part: slice, listed: _Listed, plane: np.ndarray, taken: np.ndarray) -> None:
        put_rows(taken, part, listed.of(plane))

    if planes[0][0].nbytes <= whole_bytes and not _Listed(rows[:COPY_ROWS]).dense:
        for _ in each(take_whole, *zip(*planes, strict=True)):
            pass
        return
    for part in blocks(len(rows), COPY_ROWS):
        taking = partial(take_part, part, _Listed(read_rows(rows, part)))
        for _ in each(taking, *zip(*planes, strict=True)):
            pass


def read_listed(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`values[..., rows]`, rows being listed."""
    if map_of(values) is None:
        return values[..., rows]
    out, listed = np.empty((*values.shape[:-1], len(rows)), values.dtype), _Listed(rows)

    def look_up(place: tuple[int, ...]) -> None:
        out[place] = listed.of(values[place])

    for _ in _TAKING.map(look_up, np.ndindex(values.shape[:-1])):
        pass
    return out


class _Listed:
    """Rows to be looked up in planes."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows
        self.span = slice(int(rows.min()), int(rows.max()) + 1) if len(rows) else slice(0, 0)
        self.dense = self.span.stop - self.span.start <= DENSE * len(rows)
        """Whether what lies between them is not much more, and may be read as well."""
        self.inside = rows - self.span.start if self.dense else rows

    def of(self, plane: np.ndarray) -> np.ndarray:
        """`plane[rows]`."""
        if map_of(plane) is None:
            return plane.take(self.rows)
        if self.dense:
            return read_rows(plane, self.span).take(self.inside)
        fetch(plane, self.span)
        return plane.take(self.rows)


def read_ahead(count: int, *arrays: np.ndarray) -> Iterator[tuple[slice, list[np.ndarray]]]:
    """`blocks(count)`, and these rows of arrays ([..., count]), not to be changed; of mapped ones the next are read meanwhile."""
    if all(map_of(values) is None for values in arrays):
        for part in blocks(count):
            yield part, [values[..., part] for values in arrays]
        return

    def read(rows: slice) -> list[np.ndarray]:
        size = rows.stop - rows.start
        found = [np.empty((*values.shape[:-1], size), values.dtype) for values in arrays]
        copy_all_rows(zip(arrays, found, strict=True), rows)
        return found

    with ThreadPoolExecutor(1) as reader:
        pieces = blocks(count, AHEAD_ROWS)
        piece = next(pieces, None)
        coming = None if piece is None else reader.submit(read, piece)
        while piece is not None and coming is not None:
            found, following = coming.result(), next(pieces, None)
            coming = None if following is None else reader.submit(read, following)
            for part in blocks(piece.stop - piece.start):
                yield slice(piece.start + part.start, piece.start + part.stop), [values[..., part] for values in found]
            piece = following


def map_of(values: np.ndarray) -> MappedFile | None:
    """The mapped file that an array lies in."""
    base: Any = values
    while isinstance(base, np.ndarray):
        base = base.base
    held = base.obj if isinstance(base, memoryview) else base
    return held if isinstance(held, MappedFile) else None
