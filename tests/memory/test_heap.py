"""What the process gives back to the system."""

from __future__ import annotations

import subprocess
import sys

import pytest

from flexgs_edge.memory import process as heap
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import HeapWatch

SCRIPT = """
import numpy as np
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.memory.process import current_rss
arrays = [np.ones(8000) for _ in range(1000)]
last = arrays.pop()  # it lies above the others, so that the heap cannot shrink from its end
del arrays
held = current_rss()
trim_heap()
print(held - current_rss())
"""


def test_a_trimmed_heap_holds_no_freed_arrays() -> None:
    """In a process of its own: in this one, other tests have freed memory too."""
    done = subprocess.run([sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=True)
    assert int(done.stdout) > 50 * 10**6


def test_heaps_are_trimmed_near_the_limit_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []
    held = [80]
    monkeypatch.setattr(heap, "current_rss", lambda: held[0] << 20)
    monkeypatch.setattr(heap, "return_freed_memory", lambda settings: done.append("strict"))
    monkeypatch.setattr(heap, "trim_heap", lambda: done.append("trim"))
    watch = HeapWatch()
    for size, expected in ((80, 0), (91, 2), (94, 2), (99, 3)):
        held[0] = size
        watch.check(100 << 20)
        assert len(done) == expected, size
    assert done == ["strict", "trim", "trim"]


@pytest.mark.parametrize(("size", "used", "watched"), [(2 << 20, 60, True), (2 << 20, 10, False), (1000, 60, False)])
def test_large_stages_look_at_the_heaps(size: int, used: int, watched: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    limits: list[int] = []
    monkeypatch.setattr(HeapWatch, "check", lambda self, limit: limits.append(limit))
    budget = MemoryBudget(100 << 20, used << 20)
    budget.take("a stage", size)
    assert limits == [100 << 20] * watched
    budget.heap = None
    budget.take("a stage", size)
    assert len(limits) == watched
