"""A stopwatch: wall seconds by stage of a run."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager


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
