"""Where large arrays live: in memory, or in scratch files that the kernel may drop from memory whenever it needs the room."""

from __future__ import annotations

import errno
import mmap
import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.budget import AnonymousPeak, format_size
from flexgs_edge.direct import DirectFile, is_cached
from flexgs_edge.errors import BudgetError, InputError

BLOCK_ROWS = 1 << 14
"""Rows at a time of what is done row by row: 24 MB of all fields in double precision, with the copies that NumPy makes."""
COPY_ROWS = 1 << 18
"""Rows of one plane at a time: a megabyte."""
WHOLE_BYTES = 1 << 26
"""Bytes of a plane that is held as a whole while rows in any order are taken from it: six million took 0.4 s instead of 22."""
DENSE = 4
"""Rows read for one that is wanted, at most: rather than page by page."""
_SMALL = 1 << 16
"""Bytes below which an array stays in memory in any case: a file each would cost more than it saves."""
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_IN_MEMORY = {"tmpfs", "ramfs", "devtmpfs"}


class Room:
    """Arrays in memory."""

    spills = False
    """Whether arrays lie in files: then memory holds no more than a few bytes of each row, and whatever else the kernel has
    room for."""
    folder: Path | None = None
    peak = 0
    """Most bytes that lay in mapped files at a time."""

    @property
    def peak_anonymous(self) -> int | None:
        """Peak of the memory that has no file behind it, since there were such files."""
        return None

    def close(self) -> None:
        """Stop counting; arrays stay as long as they are used."""

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """An array, not initialised; its room is given back with it."""
        return np.empty(shape, dtype)

    def copy(self, values: np.ndarray) -> np.ndarray:
        """`values` in an array of this room, C-contiguous."""
        made = self.empty(values.shape, values.dtype)
        for place in np.ndindex(values.shape[:-1]):
            for part in blocks(values.shape[-1], COPY_ROWS):
                put_rows(made[place], part, read_rows(values[place], part))
        return made

    def take(self, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """`values[..., rows]` in an array of this room, C-contiguous.

        Plane by plane: rows out of order are then looked up in one plane at a time, which memory holds where it cannot hold all
        (going through all planes for every part of the rows, 1 M Gaussians read 150 GB under a cap of 512 MiB).
        """
        made = self.empty((*values.shape[:-1], len(rows)), values.dtype)
        for place in np.ndindex(values.shape[:-1]):
            plane = values[place]
            if plane.nbytes <= WHOLE_BYTES and not _dense(rows[:COPY_ROWS]):
                plane = read_rows(plane, slice(0, plane.shape[-1]))
            for part in blocks(len(rows), COPY_ROWS):
                put_rows(made[place], part, _looked_up(plane, rows[part]))
        return made

    def file(self) -> BinaryIO:
        """A file without a name that is gone when it is closed, whatever ends the process."""
        return tempfile.TemporaryFile(dir=self.folder)

    def full(self, size: int, error: OSError) -> Exception:
        """What to raise when `size` bytes of a scratch file cannot be had."""
        return error


MEMORY = Room()
READERS = 4
"""Threads that read past the cache: in pieces of 256 KiB a disk gave one of them 1.2 GB a second, two 1.6, four 1.8."""
_READING = ThreadPoolExecutor(READERS, "read")
_Piece = tuple[DirectFile, int, memoryview]
"""A file, a byte of it, and what to fill from there on."""


class _Map(mmap.mmap):
    """A mapped file that counts itself."""

    room: Scratch
    address: int
    file: BinaryIO

    @cached_property
    def direct(self) -> DirectFile | None:
        """It, to be read past the cache."""
        return DirectFile.of(self.file)

    def __del__(self) -> None:
        self.room.used -= len(self)
        direct = self.__dict__.get("direct")
        if direct is not None:
            direct.close()
        self.file.close()


class Scratch(Room):
    """Arrays in files of a folder, mapped.

    The files have no names: whatever ends the process, a kill included, the disk space is free again. Their blocks are reserved
    before use, so that a full disk is an error and not a signal in the middle of a copy.

    Parameters
    ----------
    folder : path
        On a disk.

    Raises
    ------
    InputError
        When the folder is none, cannot be written to, or lies in memory (a tmpfs would take what it is to save).
    """

    spills = True

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        self.folder: Path = Path(os.path.realpath(folder))
        self.used = self.peak = 0
        self._watch: AnonymousPeak | None = None
        kind = file_system_of(self.folder)
        if kind in _IN_MEMORY:
            raise InputError(
                f"--scratch {folder}: this folder is a {kind}, which lies in memory itself: scratch files there would count "
                "against the limit that they are to keep; name a folder on a disk"
            )
        try:
            with tempfile.TemporaryFile(dir=self.folder):
                pass
        except OSError as error:
            raise InputError(
                f"--scratch {folder}: no scratch file can be made there ({error.strerror}); name a folder on a disk with room"
            ) from error
        self._watch = AnonymousPeak()

    @property
    def peak_anonymous(self) -> int | None:
        """See `Room.peak_anonymous`."""
        return None if self._watch is None else self._watch.peak

    def close(self) -> None:
        """See `Room.close`."""
        if self._watch is not None:
            self._watch.close()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """See `Room.empty`; raises `BudgetError` when the disk is full."""
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if size < _SMALL:
            return np.empty(shape, dtype)
        file = self.file()
        try:
            _reserve(file.fileno(), size)
            held = _Map(file.fileno(), size)
        except OSError as error:
            file.close()
            raise self.full(size, error) from error
        held.room, held.file = self, file
        if hasattr(mmap, "MADV_RANDOM"):
            # Of one row of values the kernel may read ahead. Of planes, a part of the rows is a piece of each: a disk that reads
            # 8 MiB ahead read 180 GB for 1 M Gaussians under a cap of 512 MiB. `fetch` asks for those pieces instead.
            held.madvise(mmap.MADV_SEQUENTIAL if len(shape) == 1 else mmap.MADV_RANDOM)
        self.used += size
        self.peak = max(self.peak, self.used)
        values = np.frombuffer(held, dtype).reshape(shape)
        held.address = values.ctypes.data
        return values

    def full(self, size: int, error: OSError) -> Exception:
        """What to raise when `size` bytes cannot be had."""
        if error.errno not in _FULL:
            return InputError(f"{self.folder}: cannot make a scratch file of {size} bytes ({error.strerror})")
        with suppress(OSError):
            status = os.statvfs(self.folder)
            size_free = format_size(status.f_bavail * status.f_frsize)
            return BudgetError(
                f"{self.folder}: the disk is full: scratch files hold {format_size(self.used)} there, {format_size(size)} more "
                f"are needed and {size_free} are free; free some space, or name another folder with --scratch"
            )
        return BudgetError(f"{self.folder}: the disk is full ({error.strerror})")


def _reserve(descriptor: int, size: int) -> None:
    """Give a file its blocks (or just its size where the system cannot)."""
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(descriptor, 0, size)
    else:
        os.ftruncate(descriptor, size)


def file_system_of(folder: Path, mounts: str | Path = "/proc/self/mounts") -> str | None:
    """Kind of the file system that `folder` lies on, such as `ext4`; None where the system does not tell."""
    try:
        lines = Path(mounts).read_text().splitlines()
    except OSError:
        return None
    found: tuple[int, str | None] = (-1, None)
    for line in lines:
        _, place, kind = line.split(" ")[:3]
        place = place.replace("\\040", " ")
        inside = os.path.commonpath([place, folder]) == place
        # Of two on one place, the later one hides the earlier.
        if inside and len(place) >= found[0]:
            found = (len(place), kind)
    return found[1]


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
    held = _map_of(values)
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
    held = _map_of(values)
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
    if _map_of(values) is None:
        return values[..., rows]
    out = np.empty((*values.shape[:-1], rows.stop - rows.start), values.dtype)
    copy_rows(values, rows, out)
    return out


def put_rows(values: np.ndarray, rows: slice, part: np.ndarray) -> None:
    """`values[..., rows] = part`; a mapped array is written to its file.

    Through mapped pages each costs a fault of its own: 2.4 seconds of a processor for a gigabyte under a cap, 0.3 written so.
    """
    held = _map_of(values)
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
                raise held.room.full(len(left), error) from error
            left, at = left[size:], at + size


def _planes(held: _Map, values: np.ndarray, rows: slice) -> Iterator[tuple[int, tuple[int, ...]]]:
    """Of each plane of a mapped array: the byte of its file where some rows begin, and the plane's index."""
    first = values.ctypes.data - held.address + rows.start * values.itemsize
    for place in np.ndindex(values.shape[:-1]):
        yield first + sum(number * stride for number, stride in zip(place, values.strides, strict=False)), place


def read_listed(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`values[..., rows]`, rows being listed; of a mapped array plane by plane."""
    if _map_of(values) is None:
        return values[..., rows]
    out = np.empty((*values.shape[:-1], len(rows)), values.dtype)
    for place in np.ndindex(values.shape[:-1]):
        out[place] = _looked_up(values[place], rows)
    return out


def _looked_up(plane: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """`plane[rows]`; what lies between them is read from a file as well, where that is not much more."""
    if _map_of(plane) is None or not len(rows):
        return plane.take(rows)
    first = int(rows.min())
    span = slice(first, int(rows.max()) + 1)
    if _dense(rows):
        return read_rows(plane, span).take(rows - first)
    fetch(plane, span)
    return plane.take(rows)


def _dense(rows: np.ndarray) -> bool:
    """Whether most of what lies between some rows is wanted, or nearly."""
    return not len(rows) or int(rows.max()) - int(rows.min()) < DENSE * len(rows)


def _map_of(values: np.ndarray) -> _Map | None:
    """The mapped file that an array lies in."""
    base: Any = values
    while isinstance(base, np.ndarray):
        base = base.base
    held = base.obj if isinstance(base, memoryview) else base
    return held if isinstance(held, _Map) else None


def stable_order(keys: np.ndarray, room: Room = MEMORY, rows: int = 1 << 22) -> np.ndarray:
    """[n] i64, what `np.argsort(keys, kind="stable")` gives, with no more than about `rows` keys sorted at a time in memory.

    Keys are split by value into parts of about equal size (as a sample says), which are sorted one after the other; equal keys
    are never split.
    """
    count = len(keys)
    if not room.spills or count <= rows:
        return np.argsort(keys, kind="stable")
    order = room.empty((count,), np.int64)
    sample = np.sort(keys[:: max(count // 65536, 1)])
    parts = -(-2 * count // rows)
    edges = np.unique(sample[[len(sample) * part // parts for part in range(1, parts)]])
    at = 0
    for low, high in zip([None, *edges], [*edges, None], strict=True):
        chosen = []
        for part in blocks(count, COPY_ROWS):
            some = read_rows(keys, part)
            inside = np.ones(len(some), bool) if low is None else some >= low
            if high is not None:
                inside &= some < high
            chosen.append(part.start + np.flatnonzero(inside))
        places = np.concatenate(chosen)
        put_rows(order, slice(at, at + len(places)), places[np.argsort(keys[places], kind="stable")])
        at += len(places)
    return order
