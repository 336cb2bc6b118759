"""Where a search by measured costs keeps its scene: in memory, or in scratch files."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.memory.process import return_freed_memory
from flexgs_edge.memory.rows import READING_BYTES
from flexgs_edge.memory.storage import IN_MEMORY, ScratchStorage, Storage
from flexgs_edge.methods.best.effort import EFFORTS, distil_steps
from flexgs_edge.methods.best.refit.descent import descent_bytes
from flexgs_edge.methods.best.rounds import PARTS, sum_row_bytes
from flexgs_edge.render.ahead import AHEAD_ROW_BYTES
from flexgs_edge.render.fit import (
    MOST_SUMS,
    chunk_shapes,
    padded,
    plane_bytes,
    shapes_bytes,
    streamed_bytes,
    sum_bytes,
    target_bytes,
    view_bytes,
)
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.view_buffers import view_size
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import format_size

LOG = logging.getLogger("flexgs_edge")

COST_BYTES = 16
"""Costs of a row and snapshot beside those of its SH: removal and weight, in double precision."""
BAND_BYTES = 20
"""The same for each SH degree: a cost in double precision, a mean colour."""
WORK_PLANES = 11
"""What a whole result holds for a moment, in planes of its rows (at degree 3, of 236 bytes): the rows without what was dropped,
codes, values of codes twice, colours of the last refit and of this one, and sums of the refit twice. With fewer, a
scene of which nearly all rows stay goes over its limit: docs/results/tuning.md#work_planes"""
DESCENTS = 3
"""Times the scene's stored planes that the values of all descents take. A strict target keeps more rows and needs fewer
candidates: docs/results/tuning.md#descents"""
SPILLED_ROW_BYTES = 24
"""Bytes that each row of a scene in scratch files takes of memory for a moment: choosing the cheapest rows, and lists of rows."""
SPOOL_ROW_BYTES = 52
"""Bytes that each row that a view shows takes of the scratch file for its sums (`ViewSums`)."""


def prepare_memory(run: Run[CompressOptions]) -> None:
    """Have freed memory returned, where the path of a search is not going to fit: to be called before the device is opened."""
    source, options, budget = run.source, run.options, run.budget
    rows = source.count
    if options.method == "best" and rows * row_bytes(source.sh_degree, EFFORTS[options.effort].keep) > budget.free:
        return_freed_memory()


def choose_storage(run: Run[CompressOptions], renderer: Renderer, scored: Sequence[Camera], folder: Path) -> Storage:
    """Memory, where the scene and the path of its search fit, else scratch files; says which, and how much they may take.

    Parameters
    ----------
    folder : path
        For scratch files.

    Raises
    ------
    BudgetError
        When not even the views fit, or the disk is too small.
    """
    source, options, budget = run.source, run.options, run.budget
    largest = largest_of(scored)
    rows, keep = source.count, EFFORTS[options.effort].keep
    whole = rows * row_bytes(source.sh_degree, keep)
    size, least = needed_bytes(renderer, source, scored, options)
    if size + least <= budget.free:
        return IN_MEMORY
    if distil_steps(options, len(scored)):
        budget.require("distilling (--effort max, --distil), which stays in memory as a whole,", size + least)
    budget.require(
        "a search by measured costs with all else in scratch files",
        READING_BYTES + SPILLED_ROW_BYTES * rows + least_spilled(renderer, source, largest),
    )
    storage = ScratchStorage(folder, budget.limit)
    budget.take("reading scratch files", READING_BYTES)  # as long as the process lives
    renderer.largest = largest
    spooled = SPOOL_ROW_BYTES * rows * len(scored) + renderer.fit.ahead * AHEAD_ROW_BYTES * rows
    LOG.info(
        "%d Gaussians and the path of their search need %s in memory, %s are free: they go to scratch files in %s "
        "(at most about %s; --scratch names another folder), %d rows at a time; %d bytes of each Gaussian and views of the "
        "Gaussians that they show stay in memory; %d passes over %d poses",
        rows, format_size(size + least), format_size(budget.free), storage.folder, format_size(whole + spooled),
        renderer.fit.compact_rows, SPILLED_ROW_BYTES, 2 + EFFORTS[options.effort].refit_rounds, len(scored),
    )  # fmt: skip
    return storage


def needed_bytes(
    renderer: Renderer, source: SceneSource, scored: Sequence[Camera], options: CompressOptions
) -> tuple[int, int]:
    """Bytes that a search in memory holds, and that drawing needs beside them at the least."""
    size, sums = (
        source.count * row_bytes(source.sh_degree, EFFORTS[options.effort].keep),
        sum_row_bytes(source.sh_degree),
    )
    if distil_steps(options, len(scored)):
        # A descent holds what is kept, with all that it remembers, at once: as much as the whole scene at the most.
        sums = max(sums, descent_bytes(source.sh_degree) + plane_bytes(source.sh_degree))
        size += source.count * DESCENTS * stored_bytes(source.sh_degree)
    return size, _least_bytes(renderer, source, largest_of(scored), sums)


def least_spilled(renderer: Renderer, source: SceneSource, largest: Camera) -> int:
    """Bytes that the first view of a search in scratch files needs; one that shows more rows than expected needs more."""
    fit, size = renderer.fit, view_size(renderer.backend, largest)
    rows, shown = padded(min(fit.compact_rows, source.count)), -(-source.count // fit.first_share)
    chunk = rows * streamed_bytes(source.sh_degree) + shapes_bytes(chunk_shapes(rows))
    return view_bytes(size, shown) + target_bytes(size) + sum_bytes(MOST_SUMS) * shown + chunk


def _least_bytes(renderer: Renderer, source: SceneSource, camera: Camera, sum_bytes: int) -> int:
    """Bytes that a view of `source` with targets and sums of `sum_bytes` a row needs at the least, nothing being loaded."""
    chunk = padded(min(renderer.fit.least_rows, source.count)) * streamed_bytes(source.sh_degree)
    size = view_size(renderer.backend, camera)
    return view_bytes(size, source.count) + target_bytes(size) + sum_bytes * source.count + chunk


def stored_bytes(sh_degree: int) -> int:
    """Bytes of a row's stored planes."""
    return sum(4 * field.width(sh_degree) for field in FIELD.values())


def row_bytes(sh_degree: int, keep: float) -> int:
    """Bytes that a search holds for each row of its scene, at most, beside what the renderer counts.

    Either snapshots down to nothing, each `keep` of the one before; or, when nearly all is kept, one of them and all that a
    whole result of it needs. What lies between is between.
    """
    planes = stored_bytes(sh_degree)
    snapshot = planes + COST_BYTES + BAND_BYTES * sh_degree
    parts = PARTS * 8 * (2 + 4 * sh_degree)
    return round(max(snapshot / (1 - keep), snapshot + WORK_PLANES * planes)) + parts
