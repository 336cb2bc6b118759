"""Read scratch files past the kernel's page cache (O_DIRECT), if the cache does not hold the pages already.

Under a memory cap, each page read through the cache counts against the cap, evicts another page and is copied. If we
read more in turn than fits, pages are evicted before we need them again. A read past the cache leaves cached pages
alone: docs/results/tuning.md#disks
"""

from __future__ import annotations

import ctypes
import mmap
import os
import threading
from contextlib import suppress
from functools import cache
from typing import BinaryIO

import numpy as np

BUFFER_BYTES = 1 << 21
"""Bytes of the buffer of each thread that reads past the cache: one huge page. Disks fill scattered small pages more
slowly: docs/results/tuning.md#disks"""
_HELD = threading.local()


class DirectFile:
    """A second descriptor of an open file, which reads past the cache."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @classmethod
    def of(cls, file: BinaryIO) -> DirectFile | None:
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
    held: memoryview = _HELD.buffer
    return held


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
