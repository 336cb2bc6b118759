"""Heaps of the C library: freed arrays go back to the system, so that the process holds no more than its limit."""

from __future__ import annotations

import ctypes
from contextlib import suppress

from flexgs_edge.memory.process import current_rss

MAP_THRESHOLD, TRIM_THRESHOLD, ARENA_MAX = -3, -1, -8
"""Parameters of glibc's `mallopt`: bytes from which arrays are mapped, free bytes that a heap keeps, heaps for threads."""
USUAL = {MAP_THRESHOLD: 8 << 20, TRIM_THRESHOLD: 32 << 20, ARENA_MAX: 2}
STRICT = {MAP_THRESHOLD: 1 << 20, TRIM_THRESHOLD: 2 << 20, ARENA_MAX: 2}
NEAR = 0.9
"""Share of the limit from which freed memory goes back at once: docs/results/tuning.md#heap"""
GROWTH = 8 << 20
"""Bytes by which the process must have grown since the last trim of its heaps to be worth another one."""


def return_freed_memory(settings: dict[int, int] = USUAL) -> None:
    """Make glibc return large freed arrays to the system; does nothing with another C library.

    By default, each freed mapped array raises the size from which glibc maps (up to 32 MiB). Then arrays of several
    threads leave holes in heaps, and the peak rises. `STRICT` costs time: the kernel clears each page that is mapped again.
    It works best before any large allocation: docs/results/tuning.md#memory
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in settings.items():
            mallopt(parameter, value)


def trim_heap() -> None:
    """Return what is freed by now to the system; does nothing with another C library than glibc.

    `return_freed_memory` bounds the holes of arrays that are mapped; the heaps of threads keep those of smaller arrays until
    this call. Call it before work whose limit counts all resident memory: docs/results/tuning.md#memory
    """
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


class HeapWatch:
    """Returns freed memory to the system once the process comes near its limit. Until then it costs nothing."""

    def __init__(self) -> None:
        self._strict = False
        self._trimmed = 0

    def check(self, limit: int) -> None:
        """Trim the heaps if the process holds nearly `limit` bytes."""
        held = current_rss()
        if held < NEAR * limit or held < self._trimmed + GROWTH:
            return
        if not self._strict:
            return_freed_memory(STRICT)
            self._strict = True
        trim_heap()
        self._trimmed = current_rss()
