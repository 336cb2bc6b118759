"""Open the renderer of a run."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.run_info import RunInfo
from flexgs_edge.run.counted_backend import counted_backend
from flexgs_edge.run.decoding import read_often
from flexgs_edge.run.foresight import drawing_bytes, foresee
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import Run
from flexgs_edge.run.spent import run_info


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
