"""Where large arrays live: in memory, or in mapped scratch files whose pages the kernel can drop when it needs room."""

import math
import mmap
import os
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge.errors import DISK_FULL, BudgetError, InputError
from flexgs_edge.memory.process import AnonymousPeak
from flexgs_edge.memory.rows import (
    COPY_ROWS,
    MappedFile,
    blocks,
    put_rows,
    read_ahead,
    read_listed,
    read_rows,
    take_rows,
)
from flexgs_edge.units import format_size

LEAST_BYTES = 1 << 16
"""Bytes of the smallest array that lies in a file. A file for each smaller one would cost more than it saves."""
WHOLE_BYTES = 1 << 26
"""Least size of a plane, in bytes, that may be read as a whole to take rows in any order. Otherwise each row would be a
read of its own: docs/results/tuning.md#disks"""
WHOLE_SHARE = 16  # Such a plane may be as large as this part of the limit (one in 16), if that is more
_IN_MEMORY = {"tmpfs", "ramfs", "devtmpfs"}


class Storage:
    """Allocates arrays in memory; the base of `ScratchStorage`."""

    spills = False
    """Whether arrays lie in files. Then memory need hold only a few bytes for each row; the page cache takes what is free."""
    folder: Path | None = None
    whole_bytes = WHOLE_BYTES  # Bytes of the largest plane to hold as a whole; see `take_rows`
    peak = 0  # Most bytes that lay in files at one time

    @property
    def peak_anonymous(self) -> int | None:
        """Peak of the process's memory without file pages, in bytes, if arrays lie in files; else None."""
        return None

    def close(self) -> None:
        """Stop sampling the memory; arrays stay valid."""

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """A new array, not initialised; its room is freed with it."""
        return np.empty(shape, dtype)

    def copy(self, values: np.ndarray) -> np.ndarray:
        """Copy `values` to a new C-contiguous array of this storage."""
        made = self.empty(values.shape, values.dtype)
        for place in np.ndindex(values.shape[:-1]):
            for part in blocks(values.shape[-1], COPY_ROWS):
                put_rows(made[place], part, read_rows(values[place], part))
        return made

    def take(self, values: np.ndarray, rows: np.ndarray) -> np.ndarray:
        """Copy `values[..., rows]` to a new C-contiguous array of this storage."""
        made = self.empty((*values.shape[:-1], len(rows)), values.dtype)
        take_rows(values, rows, made, self.whole_bytes)
        return made

    def file(self) -> BinaryIO:
        """A new nameless file, which vanishes when it is closed or the process ends. Report its size with `count`."""
        return tempfile.TemporaryFile(dir=self.folder)

    def count(self, size: int) -> None:
        """Count `size` more bytes in a `file`; a negative size when it is closed."""

    def full(self, size: int, error: OSError) -> Exception:
        """The error to raise if a scratch file cannot grow by `size` bytes."""
        return error


IN_MEMORY = Storage()


class ScratchStorage(Storage):
    """Allocates arrays in mapped files of a folder.

    The files have no names, so their disk space is free again however the process ends. Their blocks are reserved
    before use, so that a full disk raises an error instead of a signal in the middle of a copy.

    `folder`: on a disk. `limit`: bytes that the process may hold; larger limits let larger planes be held as a whole.
    `least`: arrays of fewer bytes always stay in memory. `whole`: see `WHOLE_BYTES`. Raises `InputError` if the folder
    does not exist, cannot be written to, or lies in memory (a tmpfs would take the memory it should save).
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
                f"--scratch {folder}: this folder is on a {kind}, which lies in memory: scratch files there would count "
                "against the memory limit; name a folder on a disk"
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
        return None if self._watch is None else self._watch.peak

    def close(self) -> None:
        if self._watch is not None:
            self._watch.close()

    def empty(self, shape: tuple[int, ...], dtype: Any) -> np.ndarray:
        """See `Storage.empty`; raises `BudgetError` if the disk is full."""
        size = math.prod(map(int, shape)) * np.dtype(dtype).itemsize
        if size < self._least:
            return np.empty(shape, dtype)
        file = self.file()
        try:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)
            else:  # no blocks can be reserved
                os.ftruncate(file.fileno(), size)
            held = MappedFile(file.fileno(), size)
        except OSError as error:
            file.close()
            raise self.full(size, error) from error
        held.storage, held.file = self, file
        self.count(size)
        if hasattr(mmap, "MADV_RANDOM"):
            # The kernel may read ahead in an array with one plane. With several planes, a part of the rows is a piece
            # of each plane, and reading ahead would read the file many times over. `fetch` asks for the pieces instead:
            # docs/results/tuning.md#disks
            held.madvise(mmap.MADV_SEQUENTIAL if len(shape) == 1 else mmap.MADV_RANDOM)
        values = np.frombuffer(held, dtype).reshape(shape)
        held.address = values.ctypes.data
        return values

    def count(self, size: int) -> None:
        self.used += size
        self.peak = max(self.peak, self.used)

    def full(self, size: int, error: OSError) -> Exception:
        """The error to raise if a scratch file cannot grow by `size` bytes."""
        if error.errno not in DISK_FULL:
            return InputError(f"{self.folder}: cannot make a scratch file of {size} bytes ({error.strerror})")
        with suppress(OSError):
            status = os.statvfs(self.folder)
            size_free = format_size(status.f_bavail * status.f_frsize)
            return BudgetError(
                f"{self.folder}: the disk is full: scratch files hold {format_size(self.used)} there, {format_size(size)} more "
                f"are needed and {size_free} are free; free some space, or name another folder with --scratch"
            )
        return BudgetError(f"{self.folder}: the disk is full ({error.strerror})")


def file_system_of(folder: Path, mounts: str | Path = "/proc/self/mounts") -> str | None:
    """Kind of the file system that holds `folder`, such as `ext4`; None if the system does not tell."""
    try:
        lines = Path(mounts).read_text().splitlines()
    except OSError:
        return None
    found: tuple[int, str | None] = (-1, None)
    for line in lines:
        _, place, kind = line.split(" ")[:3]
        place = place.replace("\\040", " ")
        inside = os.path.commonpath([place, folder]) == place
        # If two file systems are mounted on one place, the later one hides the earlier.
        if inside and len(place) >= found[0]:
            found = (len(place), kind)
    return found[1]


class OrderedPlanes:
    """Columns of planes in another order, read in parts.

    Planes in memory are indexed when they are read. Planes in files are reordered first, one by one; otherwise every
    part would read pages all over every plane.

    `planes`: [width, n] of each field. `order`: [n], the row that comes at each place; None keeps the order. `storage`:
    holds the reordered planes.
    """

    def __init__(self, planes: Mapping[str, np.ndarray], order: np.ndarray | None, storage: Storage) -> None:
        self._planes, self._order = dict(planes), order
        if order is not None and storage.spills:
            self._planes = {name: storage.take(values, order) for name, values in planes.items() if name != "means"}
            self._order = None

    def parts(self, count: int, *fields: str) -> Iterator[tuple[slice, list[np.ndarray]]]:
        """Yield the first `count` rows part by part: their slice, and [width, m] of each field."""
        planes = [self._planes[field] for field in fields]
        if self._order is None:
            yield from read_ahead(count, *planes)
            return
        for rows in blocks(count):
            yield rows, [values[:, self._order[rows]] for values in planes]

    def band(self, degree: int, rows: np.ndarray) -> np.ndarray:
        """[3, 2l + 1, m], the coefficients of SH degree l of the given rows."""
        values = self._planes["sh_rest"]
        band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
        rgb = values.reshape(3, len(values) // 3, values.shape[1])[:, band]
        return read_listed(rgb, rows if self._order is None else self._order[rows])


def stable_order(keys: np.ndarray, storage: Storage = IN_MEMORY, rows: int = 1 << 22) -> np.ndarray:
    """Argsort as `np.argsort(keys, kind="stable")`, with about `rows` keys in memory at a time.

    We split the keys by value into parts of about equal size, estimated from a sample, and sort one part after the
    other. Equal keys always fall into one part.

    Returns [n] i64.
    """
    count = len(keys)
    if not storage.spills or count <= rows:
        return np.argsort(keys, kind="stable")
    order = storage.empty((count,), np.int64)
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
