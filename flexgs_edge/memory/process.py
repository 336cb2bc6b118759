"""What the system says of this process: memory held, memory left, and memory given back."""

from __future__ import annotations

import ctypes
import resource
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

SAMPLE_SECONDS = 0.05
"""Seconds between looks at the memory: peaks that are shorter may be missed."""

_MALLOPT = {-3: 8 << 20, -1: 32 << 20, -8: 2}
"""glibc's M_MMAP_THRESHOLD and M_TRIM_THRESHOLD in bytes, and M_ARENA_MAX: heaps of threads."""


def peak_rss() -> int:
    """Peak resident memory of this process so far, in bytes."""
    try:
        # Not ru_maxrss where it can be helped: that one survives exec, so it may be the peak of whoever started us.
        with open("/proc/self/status", "rb") as status:
            return next(int(line.split()[1]) for line in status if line.startswith(b"VmHWM:")) * 1024
    except (OSError, StopIteration):
        pass
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def current_rss() -> int:
    """Resident memory of this process now, in bytes (the peak where /proc is missing)."""
    try:
        with open("/proc/self/statm") as statm:
            return int(statm.read().split()[1]) * resource.getpagesize()
    except OSError:
        return peak_rss()


def anonymous_rss() -> int | None:
    """Resident memory of this process without a file behind it, in bytes; None where the system does not tell."""
    try:
        with open("/proc/self/status", "rb") as status:
            return next(int(line.split()[1]) for line in status if line.startswith(b"RssAnon:")) * 1024
    except (OSError, StopIteration):
        return None


class AnonymousPeak:
    """Watches the memory that no file stands behind, from now on: the kernel keeps no peak of it.

    Pages of mapped scratch files are resident as long as nobody needs the room, so they tell nothing of what a run needs.
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
        """Stop watching."""
        self._stop.set()
        self._thread.join()


def available_memory(proc: str | Path = "/proc", groups: str | Path = "/sys/fs/cgroup") -> int:
    """Memory that the machine could give now, in bytes (1 GiB where it cannot tell).

    A control group (a container, a service) with a limit gives what is left of its own: no error comes beyond it, the
    kernel kills the process.
    """
    free = 2**30
    with suppress(OSError):
        for line in (Path(proc) / "meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                free = int(line.split()[1]) * 1024
    return max(min([free, *_left_in_groups(Path(proc), Path(groups))]), 0)


def _left_in_groups(proc: Path, groups: Path) -> Iterator[int]:
    """Bytes that each memory limit above this process leaves, in both versions of the kernel's interface."""
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
        # From inside a container the path may be the host's: the folders that are there count, from the top down.
        for part in ("", *(part for part in path.split("/") if part not in ("", ".."))):
            place = place / part
            with suppress(OSError, ValueError):  # ValueError: the word "max"
                limit = int((place / most).read_text())
                stat = dict(line.split() for line in (place / "memory.stat").read_text().splitlines())
                # Files read once are counted as used, and given up first.
                yield limit - int((place / used).read_text()) + int(stat.get(cache, 0))


def return_freed_memory() -> None:
    """Have the C library return large arrays to the system when they are freed; nothing where it is not glibc.

    By default every free of a mapped array raises the size that is mapped (to 32 MiB), so the arrays of two threads end
    up in heaps with holes, and the peak rises. Lower limits cost time instead: the kernel clears each page that comes
    back, by a fault each. To be called before anything large is allocated: docs/results/tuning.md#memory
    """
    with suppress(OSError, AttributeError):
        mallopt = ctypes.CDLL(None).mallopt
        for parameter, value in _MALLOPT.items():
            mallopt(parameter, value)
