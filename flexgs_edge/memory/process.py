"""Memory of this process as the system reports it: held now, at its peak, and still available."""

import ctypes
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

SAMPLE_SECONDS = 0.05  # Seconds between two samples of the memory; shorter peaks may be missed
MAP_THRESHOLD, TRIM_THRESHOLD, ARENA_MAX = -3, -1, -8
"""Parameters of glibc's `mallopt`: bytes from which arrays are mapped, free bytes that a heap keeps, heaps for threads."""
USUAL = {MAP_THRESHOLD: 8 << 20, TRIM_THRESHOLD: 32 << 20, ARENA_MAX: 2}
STRICT = {MAP_THRESHOLD: 1 << 20, TRIM_THRESHOLD: 2 << 20, ARENA_MAX: 2}
NEAR = 0.9  # Share of the limit from which freed memory goes back at once: docs/results/tuning.md#heap
GROWTH = 8 << 20  # Bytes by which the process must have grown since the last trim of its heaps to be worth another one


def peak_rss() -> int:
    """Peak resident memory of this process so far, in bytes."""
    try:
        # ru_maxrss survives exec, so it may be the peak of the program that started this one.
        with open("/proc/self/status", "rb") as status:
            return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) * 1024
    except (OSError, StopIteration):
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def current_rss() -> int:
    """Resident memory of this process now, in bytes; its peak if there is no /proc."""
    try:
        with open("/proc/self/statm") as statm:
            return int(statm.read().split()[1]) * resource.getpagesize()
    except OSError:
        return peak_rss()


def anonymous_rss() -> int | None:
    """Resident memory of this process without pages of files, in bytes; None if the system does not tell."""
    try:
        with open("/proc/self/status", "rb") as status:
            return next(int(line.split()[1]) for line in status if line.startswith(b"RssAnon:")) * 1024
    except (OSError, StopIteration):
        return None


class AnonymousPeak:
    """Samples the peak of the anonymous memory in a thread, since the kernel keeps no such peak.

    Resident pages of mapped scratch files do not count: the kernel drops them as soon as it needs the room.
    """

    def __init__(self) -> None:
        self.peak = anonymous_rss()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, name="memory", daemon=True)
        self._thread.start()

    def _watch(self) -> None:
        while not self._stop.wait(SAMPLE_SECONDS):
            self.peak = max(self.peak or 0, anonymous_rss() or 0) or None

    def close(self) -> None:
        """Stop sampling."""
        self._stop.set()
        self._thread.join()


def available_memory(proc: str | Path = "/proc", groups: str | Path = "/sys/fs/cgroup") -> int:
    """Memory that this process can still get, in bytes; 1 GiB if the system does not tell.

    A limit of a control group (a container, a service) counts too: beyond it the kernel kills the process, with no error.
    """
    free = 2**30
    with suppress(OSError):
        for line in (Path(proc) / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free = int(line.split()[1]) * 1024
    return max(min([free, *_left_in_groups(Path(proc), Path(groups))]), 0)


def _left_in_groups(proc: Path, groups: Path) -> Iterator[int]:
    """Bytes left under each memory limit above this process, for versions 1 and 2 of control groups."""
    try:
        lines = (proc / "self" / "cgroup").read_text().splitlines()
    except OSError:
        return
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            place, most, used, cache = groups, "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            place, most = groups / "memory", "memory.limit_in_bytes"
            used, cache = "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        # In a container, the path may be the host's. We take the folders that exist, from the top down.
        for part in ("", *(part for part in path.split("/") if part not in ("", ".."))):
            place = place / part
            with suppress(OSError, ValueError):  # ValueError: the word "max"
                limit = int((place / most).read_text())
                stat = dict(line.split() for line in (place / "memory.stat").read_text().splitlines())
                # Inactive file pages count as used, but the kernel drops them first.
                yield limit - int((place / used).read_text()) + int(stat.get(cache, 0))


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
