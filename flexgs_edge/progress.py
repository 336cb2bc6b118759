"""What is said and timed while work goes on: the log, bars on stderr (none in quiet runs and pipes), and a stopwatch."""

import logging
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
LOG = logging.getLogger("flexgs_edge")


class Progress:
    """Shows progress bars on stderr, or none. `enabled`: show bars. By default, only if stderr is a terminal."""

    def __init__(self, enabled: bool | None = None) -> None:
        self.enabled = sys.stderr.isatty() if enabled is None else enabled

    def track(self, items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
        """Iterate over `items`, and show a bar with the name `label`."""
        if not self.enabled:
            yield from items
            return
        from tqdm import tqdm  # slow to import, and a quiet run does not need it

        yield from tqdm(items, desc=label, total=total, leave=False, file=sys.stderr)


SILENT = Progress(enabled=False)


class Stopwatch:
    """Wall seconds by stage, in the order of first entry.

    The time of a stage inside another counts for the inner stage only.
    """

    def __init__(self) -> None:
        self.stages: dict[str, float] = {}
        self._inner = 0.0
        self._started = time.perf_counter()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the block's wall time to `name`."""
        started, outside, self._inner = time.perf_counter(), self._inner, 0.0
        self.stages.setdefault(name, 0.0)
        try:
            yield
        finally:
            took = time.perf_counter() - started
            self.stages[name] += took - self._inner
            self._inner = outside + took

    @property
    def total(self) -> float:
        """Seconds since the stopwatch was created."""
        return time.perf_counter() - self._started
