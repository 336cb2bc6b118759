"""The memory limit that a run is expected to need. Only the error about too small a limit asks for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.cameras.order import in_picture
from flexgs_edge.memory.process import return_freed_memory
from flexgs_edge.render.fit import DEFAULT, GUESS, ViewSize, compact_bytes, padded, streamed_bytes, view_bytes
from flexgs_edge.run.counted_backend import BUILD_BYTES, RUNTIME_BYTES
from flexgs_edge.run.quality_evaluator import work_bytes
from flexgs_edge.run.run import Run
from flexgs_edge.scene.source import some_positions

BLOCKS = 64  # Blocks of a view's passes on the device: as many as a processor of 16 cores has


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
