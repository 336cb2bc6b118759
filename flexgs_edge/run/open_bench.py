"""Open what draws: the backend, the renderer, and the cluster where one is asked for."""

from __future__ import annotations

from types import TracebackType

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.open_backend import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import current_rss, peak_rss
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import RunInfo
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.views.cluster import Cluster
from flexgs_edge.views.worker import Drawing

BUILD_BYTES = 24 * 2**20
"""What building our kernels adds to the loaded compiler (measured with PoCL, nothing cached: 19 MiB)."""


class Workspace:
    """Budget, backend and renderer of one job; a context manager that closes the backend.

    Parameters
    ----------
    options : ViewOptions
        With near plane, background, extent and antialiasing filled in.
    budget : MemoryBudget
        Everything is taken from it.
    clock : Stopwatch
        Gets the stage `device`.
    cluster : str, optional
        Address of workers that draw for it (stage `cluster`), each with the run's memory limit for itself.
    """

    def __init__(
        self, options: ViewOptions, budget: MemoryBudget, clock: Stopwatch, cluster: str | None = None
    ) -> None:
        assert options.near is not None and options.background is not None
        assert options.extent is not None and options.antialiased is not None
        self.budget = budget
        self.clock = clock
        self.backend = counted_backend(options.device, budget, clock)
        self.renderer = Renderer(
            self.backend, budget, options.near, options.background, options.extent, options.antialiased
        )
        if cluster is not None:
            words = options.near, options.background, options.extent, options.antialiased
            with clock.stage("cluster"):
                self.renderer.cluster = Cluster(cluster, Drawing(options.device, options.memory_limit, *words))

    def __enter__(self) -> Workspace:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self.renderer.cluster is not None:
            self.renderer.cluster.close()
        self.renderer.release()
        self.backend.close()

    def run_info(self) -> RunInfo:
        """What this run took and ran on (never stored in files)."""
        return run_info(self.budget, self.clock, self.backend)


def counted_backend(device: str | None, budget: MemoryBudget, clock: Stopwatch) -> Backend:
    """The backend that `device` names (stage `device`), and what its runtime holds taken from the budget."""
    before = current_rss()
    with clock.stage("device"):
        backend = open_backend(device, budget)
    if not backend.is_numpy:
        # The runtime and its compiler stay loaded: 80 MiB for PoCL with its kernels cached, 210 MiB without.
        budget.take("the OpenCL runtime", max(current_rss() - before, 0) + BUILD_BYTES)
    return backend


def run_info(
    budget: MemoryBudget, clock: Stopwatch, backend: Backend | None = None, storage: Storage = IN_MEMORY
) -> RunInfo:
    """Seconds, memory and device of a run."""
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
