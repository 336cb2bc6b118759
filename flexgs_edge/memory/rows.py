"""Copy rows of arrays that may lie in mapped scratch files, with plain reads and writes instead of page faults."""

import ctypes
import mmap
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cache, cached_property, partial
from typing import Any, BinaryIO, Protocol

import numpy as np

BUFFER_BYTES = 1 << 21
"""Bytes of the buffer of each thread that reads past the cache: one huge page. Disks fill scattered small pages more
slowly: docs/results/tuning.md#disks"""
_HELD = threading.local()
BLOCK_ROWS = 1 << 14  # Rows of a part in loops over rows: 24 MB of all fields in f64, with the copies that NumPy makes
AHEAD_ROWS = 1 << 15  # Rows that are read ahead at a time
COPY_ROWS = 1 << 18  # Rows of one plane that are copied at a time: a megabyte of f32
DENSE = 4  # Listed rows are read as one span if it holds at most so many rows for each listed one, else page by page
READERS = 4  # Threads that read past the cache. One thread does not keep a disk busy: docs/results/tuning.md#disks
_READING = ThreadPoolExecutor(READERS, "read")
_TAKING = ThreadPoolExecutor(2, "take")
"""Threads that take listed rows: while one plane is read or written, another is indexed."""
READING_BYTES = (READERS + 4) * BUFFER_BYTES
"""Bytes of the buffers of the reading threads, and of the threads that take rows, load chunks or read ahead."""


class DirectFile:
    """A second descriptor of an open file, which reads past the cache."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @classmethod
    def of(cls, file: BinaryIO) -> "DirectFile | None":
        """Open `file` again; None if the system or the disk does not support it."""
        with suppress(OSError, AttributeError):
            return cls(os.open(f"/proc/self/fd/{file.fileno()}", os.O_RDONLY | os.O_DIRECT))
        return None

    def read(self, at: int, out: memoryview) -> None:
        """Fill `out` (bytes) from byte `at` of the file; raises `EOFError` if the file is too short."""
        buffer = _buffer()
        while out:
            # O_DIRECT takes only offsets and sizes in whole blocks of the disk; a page is a multiple of them.
            start = at // mmap.PAGESIZE * mmap.PAGESIZE
            end = min(-(-(at + len(out)) // mmap.PAGESIZE) * mmap.PAGESIZE, start + BUFFER_BYTES)
            got = os.preadv(self._descriptor, [buffer[: end - start]], start)
            part = buffer[at - start : min(got, at - start + len(out))]
            if not part:
                raise EOFError(f"a scratch file ends at byte {start + got}")
            out[: len(part)] = part
            out, at = out[len(part) :], at + len(part)

    def close(self) -> None:
        """Close the second descriptor."""
        os.close(self._descriptor)


def _buffer() -> memoryview:
    """The read buffer of the current thread."""
    if not hasattr(_HELD, "buffer"):
        pages = mmap.mmap(-1, 2 * BUFFER_BYTES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # shared: no huge pages
        if hasattr(mmap, "MADV_HUGEPAGE"):
            with suppress(OSError):
                pages.madvise(mmap.MADV_HUGEPAGE)
        first = -np.frombuffer(pages, np.uint8).ctypes.data % BUFFER_BYTES
        _HELD.buffer = memoryview(pages)[first : first + BUFFER_BYTES]
    return _HELD.buffer


def is_cached(address: int, size: int) -> bool:
    """Whether the page cache seems to hold `size` bytes of a file mapped at `address`.

    It is True if the system does not tell. We ask for the first and the last page only, since neighbours come and go
    together. A wrong answer costs time, no data.
    """
    library = _library()
    if library is None:
        return True
    held = ctypes.c_ubyte()
    for place in (address, address + max(size - 1, 0)):
        told = library.mincore(place // mmap.PAGESIZE * mmap.PAGESIZE, 1, ctypes.byref(held)) == 0
        if told and not held.value & 1:  # the other bits are undefined
            return False
    return True


@cache
def _library() -> ctypes.CDLL | None:
    with suppress(OSError, TypeError, AttributeError):
        library = ctypes.CDLL(None)
        library.mincore.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p
        return library
    return None


_Piece = tuple[DirectFile, int, memoryview]
"""A part to read: its file, its first byte in the file, and the memory to fill."""


class _Owner(Protocol):
    """The storage that a mapped file belongs to."""

    used: int  # Bytes of all its mapped files

    def full(self, size: int, error: OSError) -> Exception:
        """The error to raise if the disk has no room for `size` bytes."""


class MappedFile(mmap.mmap):
    """A mapped scratch file; when it is freed, its bytes no longer count in its storage."""

    storage: _Owner
    address: int
    file: BinaryIO

    @cached_property
    def direct(self) -> DirectFile | None:
        """The file, opened to be read past the cache; None if that is not possible."""
        return DirectFile.of(self.file)

    def __del__(self) -> None:
        self.storage.used -= len(self)
        direct = self.__dict__.get("direct")
        if direct is not None:
            direct.close()
        self.file.close()


def blocks(count: int, rows: int = BLOCK_ROWS) -> Iterator[slice]:
    """Yield parts of `count` rows, so that temporary arrays of row numbers and f64 values stay small."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))


def fetch(values: np.ndarray, rows: slice) -> None:
    """Ask the kernel to read rows of every plane of a mapped array at once; no effect on arrays in memory.

    `values`: [..., n]. `rows`: `slice(start, stop)`.
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
    """Copy `values[..., rows]` to `out`; a mapped array is read from its file, without the interpreter's lock.

    `values`: [..., n], planes C-contiguous. `rows`: `slice(start, stop)`. `out`: [..., stop - start], of the same type.
    """
    copy_all_rows([(values, out)], rows)


def copy_all_rows(pairs: Iterable[tuple[np.ndarray, np.ndarray]], rows: slice) -> None:
    """Do `copy_rows` for several pairs (values, out) at once, which keeps the disk busy."""
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
    """Copy the rows that are in memory or in the page cache; return the parts that must be read past the cache."""
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
    """`values[..., rows]`, read-only: a view of an array in memory, or a copy of a mapped one."""
    if map_of(values) is None:
        return values[..., rows]
    out = np.empty((*values.shape[:-1], rows.stop - rows.start), values.dtype)
    copy_rows(values, rows, out)
    return out


def put_rows(values: np.ndarray, rows: slice, part: np.ndarray) -> None:
    """Set `values[..., rows] = part`; a mapped array is written to its file.

    A write through the mapped pages would fault on each page: docs/results/tuning.md#disks
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
            except OSError as error:  # copy-on-write disks may be full although the blocks are reserved
                raise held.storage.full(len(left), error) from error
            left, at = left[size:], at + size


def _planes(held: MappedFile, values: np.ndarray, rows: slice) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Yield, for each plane of a mapped array, the byte of the file where the rows begin, and the index of the plane."""
    first = values.ctypes.data - held.address + rows.start * values.itemsize
    for place in np.ndindex(values.shape[:-1]):
        yield first + sum(number * stride for number, stride in zip(place, values.strides, strict=False)), place


def take_rows(values: np.ndarray, rows: np.ndarray, out: np.ndarray, whole_bytes: int) -> None:
    """Copy listed rows: `out[...] = values[..., rows]`.

    For files, rows out of order are taken plane by plane, two planes at a time, so that memory holds the planes in use.
    A loop over parts of the rows would read all planes once a part: docs/results/tuning.md#disks

    `values`: [..., n]. `rows`: [m], row numbers in any order. `out`: [..., m], of the same type. `whole_bytes`: bytes
    of the largest plane that may be held in memory as a whole; two are held at a time.
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
    """`values[..., rows]` for listed rows, in memory."""
    if map_of(values) is None:
        return values[..., rows]
    out, listed = np.empty((*values.shape[:-1], len(rows)), values.dtype), _Listed(rows)

    def look_up(place: tuple[int, ...]) -> None:
        out[place] = listed.of(values[place])

    for _ in _TAKING.map(look_up, np.ndindex(values.shape[:-1])):
        pass
    return out


class _Listed:
    """Row numbers to look up in planes, and the span that they cover."""

    def __init__(self, rows: np.ndarray) -> None:
        self.rows = rows
        self.span = slice(int(rows.min()), int(rows.max()) + 1) if len(rows) else slice(0, 0)
        self.dense = self.span.stop - self.span.start <= DENSE * len(rows)
        """Whether the span is so short that we read all of it."""
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
    """Yield `blocks(count)` with these rows of each array ([..., count]), read-only; mapped arrays are read ahead."""
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
