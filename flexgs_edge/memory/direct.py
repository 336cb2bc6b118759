"""Reading files past the kernel's cache of pages, where it does not hold them.

Under a cap a page that is read through the cache is charged to the control group, pushes another page out, and is copied; and
where more is read in turn than there is room for, pages are pushed out before they are read again. Read past the cache they leave
those alone that are there: docs/results/tuning.md#disks
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
"""Of each thread that reads past the cache: one huge page. A disk fills small pages, which lie anywhere, more slowly:
docs/results/tuning.md#disks"""
_HELD = threading.local()


class DirectFile:
    """An open file, opened once more to be read past the cache."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    @classmethod
    def of(cls, file: BinaryIO) -> DirectFile | None:
        """`file` once more; None where the system or the disk cannot."""
        with suppress(OSError, AttributeError):
            return cls(os.open(f"/proc/self/fd/{file.fileno()}", os.O_RDONLY | os.O_DIRECT))
        return None

    def read(self, at: int, out: memoryview) -> None:
        """Fill `out` (bytes) from byte `at` of the file on; raises `EOFError` where the file ends before."""
        buffer = _buffer()
        while out:
            # Places and sizes are to be whole blocks of the disk; a page is.
            start = at // mmap.PAGESIZE * mmap.PAGESIZE
            end = min(-(-(at + len(out)) // mmap.PAGESIZE) * mmap.PAGESIZE, start + BUFFER_BYTES)
            got = os.preadv(self._descriptor, [buffer[: end - start]], start)
            part = buffer[at - start : min(got, at - start + len(out))]
            if not part:
                raise EOFError(f"a scratch file ends at byte {start + got}")
            out[: len(part)] = part
            out, at = out[len(part) :], at + len(part)

    def close(self) -> None:
        """Close this opening of it."""
        os.close(self._descriptor)


def _buffer() -> memoryview:
    """The buffer of the thread that asks."""
    if not hasattr(_HELD, "buffer"):
        pages = mmap.mmap(-1, 2 * BUFFER_BYTES, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # shared ones stay small
        if hasattr(mmap, "MADV_HUGEPAGE"):
            with suppress(OSError):
                pages.madvise(mmap.MADV_HUGEPAGE)
        first = -np.frombuffer(pages, np.uint8).ctypes.data % BUFFER_BYTES
        _HELD.buffer = memoryview(pages)[first : first + BUFFER_BYTES]
    held: memoryview = _HELD.buffer
    return held


def is_cached(address: int, size: int) -> bool:
    """Whether memory seems to hold the `size` bytes of a file that are mapped at `address`; True where nobody can tell.

    Asked are the first page and the last: neighbours come and go together, and what is wrong now and then costs only time.
    """
    library = _library()
    if library is None:
        return True
    held = ctypes.c_ubyte()
    for place in (address, address + max(size - 1, 0)):
        told = library.mincore(place // mmap.PAGESIZE * mmap.PAGESIZE, 1, ctypes.byref(held)) == 0
        if told and not held.value & 1:  # the other bits may be anything
            return False
    return True


@cache
def _library() -> ctypes.CDLL | None:
    with suppress(OSError, TypeError, AttributeError):
        library = ctypes.CDLL(None)
        library.mincore.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p
        return library
    return None
