"""What every job holds: a budget, a backend, a renderer, and a stopwatch over the stages."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from types import TracebackType

from flexgs_edge.budget import MemoryBudget, current_rss, peak_rss
from flexgs_edge.codec.coder import CHUNK_ROWS
from flexgs_edge.codec.encode_kernels import device_bytes
from flexgs_edge.kernels import Backend, open_backend
from flexgs_edge.pipeline.options import ViewOptions
from flexgs_edge.render import Renderer
from flexgs_edge.render.cluster import Cluster, Drawing
from flexgs_edge.report.result import RunInfo
from flexgs_edge.scratch import MEMORY, Room

DEVICE_ROWS = 40_000
"""Gaussians from which a device codes. 85 000 of fox: coded in 0.9 s instead of 1.5, decoded in 0.15 instead of 0.8; building the
kernels takes 4 s, once on a machine."""
BUILD_BYTES = 24 * 2**20
"""What building our kernels adds to the loaded compiler (measured with PoCL, nothing cached: 19 MiB)."""


class Stopwatch:
    """Wall seconds by stage, in the order of first entry; a stage inside another is counted once, as the inner one."""

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
        """Seconds since the stopwatch was made."""
        return time.perf_counter() - self._started


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


def coding_device(backend: Backend | None, budget: MemoryBudget, count: int, sh_degree: int) -> Backend | None:
    """The backend, where it codes large scenes well and memory has room for its work; None: NumPy does, with the same bytes."""
    if backend is None or not backend.threads or count < DEVICE_ROWS:
        return None
    return backend if backend.threads * device_bytes(CHUNK_ROWS, sh_degree) <= budget.free else None


def run_info(budget: MemoryBudget, clock: Stopwatch, backend: Backend | None = None, room: Room = MEMORY) -> RunInfo:
    """Seconds, memory and device of a run."""
    return RunInfo(
        seconds=clock.total,
        stages=dict(clock.stages),
        startup_seconds=clock.stages.get("device", 0.0),
        compile_seconds=backend.compile_seconds if backend else 0.0,
        memory_limit=budget.limit,
        peak_memory=peak_rss(),
        device=backend.describe() if backend else None,
        peak_anonymous=room.peak_anonymous,
        scratch=room.peak if room.spills else None,
    )
