"""Record what a run took: seconds, memory, device."""

from __future__ import annotations

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import peak_rss
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.report.run_info import RunInfo
from flexgs_edge.run.clock import Stopwatch


def run_info(
    budget: MemoryBudget, clock: Stopwatch, backend: Backend | None = None, storage: Storage = IN_MEMORY
) -> RunInfo:
    """Record seconds, memory and device of a run that has no context."""
    return RunInfo(
        seconds=clock.total,
        stages=dict(clock.stages),
        startup_seconds=clock.stages.get("device", 0.0),
        compile_seconds=backend.compile_seconds if backend else 0.0,
        memory_limit=budget.limit,
        peak_memory=peak_rss(),
        device=backend.describe() if backend else None,
        peak_anonymous=storage.peak_anonymous,
        scratch=storage.peak if storage.spills else None,
    )
