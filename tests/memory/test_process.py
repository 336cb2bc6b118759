"""What the process gives back to the system."""

from __future__ import annotations

import subprocess
import sys

SCRIPT = """
import numpy as np
from flexgs_edge.memory.process import current_rss, trim_heap
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
