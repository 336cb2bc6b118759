"""Open a backend whose memory the budget counts."""

from __future__ import annotations

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.open_backend import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss
from flexgs_edge.run.clock import Stopwatch

RUNTIME_BYTES = 88 * 2**20
"""Bound on what PoCL's runtime and its compiler take before our kernels are built. Once the device is open, it is known."""
BUILD_BYTES = 24 * 2**20
"""Bound on the bytes that building our kernels adds to the loaded compiler: docs/results/tuning.md#memory"""


def counted_backend(device: str | None, budget: MemoryBudget, clock: Stopwatch) -> Backend:
    """Open the backend that `device` names, as the stage `device`, and take its runtime's memory from the budget."""
    budget.require("the program", 0)  # whose size is known by now
    before = current_rss()
    with clock.stage("device"):
        backend = open_backend(device, budget)
    if not backend.is_numpy and not budget.runtime:
        # The runtime and its compiler stay loaded. They take more memory when no kernels are cached.
        budget.runtime = max(current_rss() - before, 0) + BUILD_BYTES
        budget.take("the OpenCL runtime", budget.runtime)
    return backend
