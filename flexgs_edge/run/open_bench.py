"""Open the bench of a run: backend, renderer and, if asked for, a cluster."""

from __future__ import annotations

from typing import Any

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.open_backend import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss, peak_rss
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import RunInfo
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import Run
from flexgs_edge.views.bench import Bench
from flexgs_edge.views.cluster import Cluster
from flexgs_edge.views.worker import Drawing

RUNTIME_BYTES = 88 * 2**20
"""Bound on what PoCL's runtime and its compiler take before our kernels are built. Once the device is open, it is known."""
BUILD_BYTES = 24 * 2**20
"""Bound on the bytes that building our kernels adds to the loaded compiler: docs/results/tuning.md#memory"""


def open_bench(run: Run[Any], cluster: str | None = None) -> Bench:
    """Open the renderer, and the cluster if there is one. Close the bench when done.

    Parameters
    ----------
    run : Run
        Names the device, and pays for memory.
    cluster : str, optional
        Address of a Dask scheduler, or `local:N`. Each worker gets the run's whole memory limit. Default: no cluster.

    Returns
    -------
    Bench
        Opening it is timed as the stages `device` and `cluster`.

    Raises
    ------
    DeviceError
        If the named device does not exist or failed its self-test.
    """
    options: ViewOptions = run.options
    assert options.near is not None and options.background is not None
    assert options.extent is not None and options.antialiased is not None
    drawing = options.near, options.background, options.extent, options.antialiased
    backend = counted_backend(options.device, run.budget, run.clock)
    bench = Bench(Renderer(backend, run.budget, *drawing))
    try:
        if cluster is not None:
            with run.clock.stage("cluster"):
                bench.cluster = Cluster(cluster, Drawing(options.device, options.memory_limit, *drawing))
        if run.reporter is not None and run.views is not None:
            run.reporter.reserve(run.budget, run.views)
    except BaseException:
        bench.close()
        raise
    return bench


def counted_backend(device: str | None, budget: MemoryBudget, clock: Stopwatch) -> Backend:
    """Open the backend that `device` names, as the stage `device`, and take its runtime's memory from the budget."""
    budget.require("the program", 0)  # whose size is known by now
    before = current_rss()
    with clock.stage("device"):
        backend = open_backend(device, budget)
    if not backend.is_numpy:
        # The runtime and its compiler stay loaded. They take more memory when no kernels are cached.
        budget.take("the OpenCL runtime", max(current_rss() - before, 0) + BUILD_BYTES)
    return backend


def bench_info(run: Run[Any], bench: Bench | None) -> RunInfo:
    """Record seconds, memory and device of a run that draws. Files never store this record: their bytes would change."""
    if bench is None:
        return run_info(run.budget, run.clock)
    return run_info(run.budget, run.clock, bench.renderer.backend, bench.renderer.storage)


def run_info(
    budget: MemoryBudget, clock: Stopwatch, backend: Backend | None = None, storage: Storage = IN_MEMORY
) -> RunInfo:
    """Record seconds, memory and device of a run that has no bench."""
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
