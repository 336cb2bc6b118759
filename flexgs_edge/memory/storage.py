"""Where large arrays live: in memory, or in scratch files that the kernel may drop from memory whenever it needs the room."""

from __future__ import annotations

import errno
import mmap
import os
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.memory.process import AnonymousPeak
from flexgs_edge.memory.rows import COPY_ROWS, MappedFile, blocks, put_rows, read_rows, take_rows
from flexgs_edge.units import format_size

LEAST_BYTES = 1 << 16
"""Bytes of the smallest array that lies in a file: smaller ones would cost more than they save."""
WHOLE_BYTES = 1 << 26
"""Least bytes of a plane that is held as a whole while rows in any order are taken from it. From a file, each row would
be a read of its own: docs/results/tuning.md#disks"""
WHOLE_SHARE = 16
"""Part of the limit (one in 16) that such a plane may take where that is more."""
_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}
_IN_MEMORY = {"tmpfs", "ramfs", "devtmpfs"}


class Storage:
    """Arrays in memory."""

    spills = False
    """Whether arrays lie in files: then memory holds no more than a few bytes of each row, and whatever else the kernel has
    room for."""
    folder: Path | None = None
    whole_bytes = WHOLE_BYTES
    """See `take_rows`."""
    peak = 0
    """Most bytes that lay in files at a time."""

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
        """`values[..., rows]` in an array of this room, C-contiguous."""
        made = self.empty((*values.shape[:-1], len(rows)), values.dtype)
        take_rows(values, rows, made, self.whole_bytes)
        return made

    def file(self) -> BinaryIO:
        """A file without a name that is gone when it is closed, whatever ends the process; who writes to it says how much."""
        return tempfile.TemporaryFile(dir=self.folder)

    def count(self, size: int) -> None:
        """So many bytes more lie in a `file` (less than none: it is closed)."""

    def full(self, size: int, error: OSError) -> Exception:
        """What to raise when `size` bytes of a scratch file cannot be had."""
        return error


IN_MEMORY = Storage()


class ScratchStorage(Storage):
    """Arrays in files of a folder, mapped.

    The files have no names: whatever ends the process, a kill included, the disk space is free again. Their blocks are reserved
    before use, so that a full disk is an error and not a signal in the middle of a copy.

    Parameters
    ----------
    folder : path
        On a disk.
    limit : int
        Bytes that the process may hold.
    least : int
        Bytes below which an array stays in memory in any case.
    whole : int
        See `WHOLE_BYTES`.

    Raises
    ------
    InputError
        When the folder is none, cannot be written to, or lies in memory (a tmpfs would take what it is to save).
    """

    spills = True

    def __init__(
        self, folder: str | os.PathLike[str], limit: int = 0, least: int = LEAST_BYTES, whole: int = WHOLE_BYTES
    ) -> None:
        self.folder: Path = Path(os.path.realpath(folder))
        self.whole_bytes = max(whole, limit // WHOLE_SHARE)
        self.used = self.peak = 0
        self._least = least
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
        """See `Storage.peak_anonymous`."""
        return None if self._watch is None else self._watch.peak

    def close(self) -> None:
        """See `Storage.close`."""
        if self._watch is not None:
            self._watch.close()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """See `Storage.empty`; raises `BudgetError` when the disk is full."""
        size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
        if size < self._least:
            return np.empty(shape, dtype)
        file = self.file()
        try:
            _reserve(file.fileno(), size)
            held = MappedFile(file.fileno(), size)
        except OSError as error:
            file.close()
            raise self.full(size, error) from error
        held.storage, held.file = self, file
        self.count(size)
        if hasattr(mmap, "MADV_RANDOM"):
            # Of one row of values the kernel may read ahead. Of planes, a part of the rows is a piece of each: reading
            # ahead would read the file many times over. `fetch` asks for those pieces instead.
            # docs/results/tuning.md#disks
            held.madvise(mmap.MADV_SEQUENTIAL if len(shape) == 1 else mmap.MADV_RANDOM)
        values = np.frombuffer(held, dtype).reshape(shape)
        held.address = values.ctypes.data
        return values

    def count(self, size: int) -> None:
        """See `Storage.count`."""
        self.used += size
        self.peak = max(self.peak, self.used)

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
