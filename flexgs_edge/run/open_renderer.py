"""Open the renderer of a run, foresee the memory that it needs, and record what the run took."""

from collections.abc import Callable
from typing import Any

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.cameras.order import in_picture
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.tested import BUILD_BYTES, RUNTIME_BYTES, counted_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import peak_rss, return_freed_memory
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.progress import Stopwatch
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import DEFAULT, GUESS, ViewSize, compact_bytes, padded, streamed_bytes, view_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import RunInfo
from flexgs_edge.run.decoding import read_often
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import work_bytes
from flexgs_edge.run.run import Run
from flexgs_edge.scene.source import some_positions

BLOCKS = 64  # Blocks of a view's passes on the device: as many as a processor of 16 cores has


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


def open_renderer(run: Run[Any], needed: Callable[[], int] | None = None, compares: bool = True) -> Renderer:
    """Open the device and the renderer. Close the renderer when done.

    With `needed`, errors about the memory limit name one that is enough for the whole run: see `foresee`.

    `run`: names the device, and pays for memory. Opening it is timed as the stage `device`. Raises `DeviceError` if the
    named device does not exist or failed its self-test.
    """
    options: ViewOptions = run.options
    assert options.near is not None and options.background is not None
    assert options.antialiased is not None
    drawing = options.near, run.background or options.background, options.antialiased
    if needed is not None:
        with run.clock.stage("open"):
            foresee(run, False, needed, compares)
    backend = counted_backend(options.device, run.budget, run.clock)
    renderer = Renderer(backend, run.budget, *drawing)
    if needed is not None:
        foresee(run, True, needed, compares)
    try:
        if run.reporter is not None and run.views is not None:
            run.reporter.reserve(run.budget, run.views)
    except BaseException:
        renderer.close()
        raise
    return renderer


def load_drawn(run: Run[Any], renderer: Renderer) -> DeviceScene:
    """Put the scene of a run on the device, to be drawn (stage `load`). Close it when done."""
    with run.clock.stage("load"):
        source = read_often(run.source, run.budget, drawing_bytes(run), renderer.backend)
        return renderer.load(run.of_source(source).scene.drawn)


def drawn_info(run: Run[Any], renderer: Renderer | None) -> RunInfo:
    """Record seconds, memory and device of a run that draws. Files never store this record: their bytes would change."""
    if renderer is None:
        return run_info(run.budget, run.clock)
    return run_info(run.budget, run.clock, renderer.backend, renderer.storage)


def foresee(
    run: Run[Any], opened: bool = False, search: Callable[[], int] | None = None, compares: bool = True
) -> None:
    """Let errors about the limit name one that is expected to be enough for all stages, not for the next one alone.

    Call it before the device is opened, and again when it is open.

    `run`: with views. `opened`: the device is open, and its memory is taken from the budget. `search`: bytes that the
    search, or what the command does in its place, needs beside the comparison of views. Default: those of drawing one
    view. `compares`: views are compared (default), not drawn alone.
    """
    budget, plan, views = run.budget, run.plan, run.seen
    reporting = views.held_out or views.train
    deciding = reporting if plan is None else plan.decide
    compared = [reporting] if deciding == reporting else [reporting, deciding]
    held = budget.used
    if not opened and run.options.device != "numpy":
        held += RUNTIME_BYTES + BUILD_BYTES

    def enough() -> int:
        compared_bytes = sum(work_bytes(views.of(indices)) for indices in compared if compares)
        return held + compared_bytes + (drawing_bytes(run) if search is None else search())

    budget.foreseen = enough
    if not opened and enough() > budget.free:
        return_freed_memory()  # before the device takes its first large blocks


def drawing_bytes(run: Run[Any]) -> int:
    """Bytes of drawing the largest view, and of the part of the scene that must be loaded for it."""
    source = run.source
    size = size_of(largest_of(run.seen.cameras))
    compact = compact_bytes(size, shown_rows(run), min(DEFAULT.compact_rows, source.count), source.sh_degree)
    least = padded(min(DEFAULT.least_rows, source.count)) * streamed_bytes(source.sh_degree)
    return min(view_bytes(size, source.count) + least, compact)


def size_of(camera: Camera) -> ViewSize:
    """The size of a camera's view, on a device with `BLOCKS` blocks."""
    return ViewSize(camera.width, camera.height, BLOCKS, BLOCKS)


def shown_rows(run: Run[Any]) -> int:
    """Rows for which a view gets room: those that lie in the picture of the view that has most of them, and some more."""
    source, positions = run.source, some_positions(run.source)
    shares = (in_picture(camera, positions, run.options.near).mean() for camera in run.seen.cameras)
    return DEFAULT.capacity(source.count, GUESS * max(shares))
