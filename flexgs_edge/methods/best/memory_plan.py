"""Decides where the method `best` keeps its scene: in memory, or in scratch files.

Before the search starts we estimate how many bytes it holds. If they do not fit into the budget, its large arrays go to
scratch files. The output has the same bytes either way, but the search takes longer.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flexgs_edge.cameras.camera import Camera, largest_of
from flexgs_edge.memory.rows import READING_BYTES
from flexgs_edge.memory.storage import IN_MEMORY, ScratchStorage, Storage
from flexgs_edge.methods.best.costs import snapshot_bytes
from flexgs_edge.methods.best.effort import EFFORTS, finetune_steps
from flexgs_edge.methods.best.poses import is_fine
from flexgs_edge.methods.best.refit.descent import descent_bytes
from flexgs_edge.methods.best.refit.streamed_descent import streamed_descent_bytes, streamed_rows
from flexgs_edge.methods.best.rounds import MOST_PARTS, PARTS, parts_of, sum_row_bytes
from flexgs_edge.progress import LOG
from flexgs_edge.render import fit as needs
from flexgs_edge.render.ahead import AHEAD_ROW_BYTES
from flexgs_edge.render.fit import DEFAULT
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.view_buffers import view_size
from flexgs_edge.run.open_renderer import drawing_bytes, shown_rows, size_of
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import format_size

SPILLED_ROW_BYTES = 24
"""Bytes of memory that each row of a scene in scratch files still takes for a moment: for choosing rows, and lists of rows."""


def expected_bytes(run: Run[CompressOptions]) -> int:
    """Bytes that the search is expected to need at least, with all in scratch files that can lie there; see `foresee`."""
    source, options = run.source, run.options
    cameras = run.seen.of(run.seen.train)
    size = size_of(largest_of(cameras))  # poses of large weight keep all their pixels
    distils = finetune_steps(options, len(cameras), source.count) > 0
    held = sum(needed_bytes(DEFAULT, size, source, len(cameras), options, distils))
    if run.output.format is not None:
        return held
    pruning = spilled_bytes(DEFAULT, source, size, shown_rows(run), False)
    few = -(-source.count // DEFAULT.first_share)  # descents begin once many rows went
    descent = spilled_bytes(DEFAULT, source, size, few, distils)
    view = max(pruning, descent, drawing_bytes(run))
    return min(held, READING_BYTES + SPILLED_ROW_BYTES * source.count + view)


@dataclass(frozen=True)
class MemoryPlan:
    """What a search takes of memory."""

    steps: int  # of the descent to a candidate; 0 for none
    held: int  # bytes of the scene and its search
    least: int  # least bytes that drawing needs beside them

    @classmethod
    def of(cls, run: Run[CompressOptions], renderer: Renderer, scored: Sequence[Camera]) -> "MemoryPlan":
        """The plan of a search with these scored poses, where the renderer's storage is."""
        source, options, largest = run.source, run.options, largest_of(scored)
        steps = finetune_steps(options, len(scored), source.count, is_fine(options, source))
        if renderer.storage.spills:
            return cls(steps, SPILLED_ROW_BYTES * source.count, least_spilled(renderer, source, largest, steps > 0))
        view = view_size(renderer.backend, largest)
        return cls(steps, *needed_bytes(renderer.fit, view, source, len(scored), options, steps > 0))


def choose_storage(run: Run[CompressOptions], renderer: Renderer, scored: Sequence[Camera], folder: Path) -> Storage:
    """Memory if the scene and its search fit, else scratch files; logs where these go and how large they may get.

    `renderer`: with nothing loaded. Raises `BudgetError` when not even the views fit, or the disk is too small.
    """
    source, options, budget = run.source, run.options, run.budget
    plan, largest = MemoryPlan.of(run, renderer, scored), largest_of(scored)
    if plan.held + plan.least <= budget.free:
        return IN_MEMORY
    rows, keep = source.count, EFFORTS[options.effort].keep
    whole = rows * row_bytes(source.sh_degree, keep, _most_parts(options, len(scored)))
    budget.require(
        "a search by measured costs with all else in scratch files",
        READING_BYTES + SPILLED_ROW_BYTES * rows + least_spilled(renderer, source, largest, plan.steps > 0),
    )
    storage, budget.heap = ScratchStorage(folder, budget.limit), None
    budget.take("reading scratch files", READING_BYTES)  # until the process ends
    renderer.largest = largest
    spool = 52 * rows * len(scored)  # the scratch file of sums (`ViewSums`), if each view shows all rows
    most = whole + spool + renderer.fit.ahead * AHEAD_ROW_BYTES * rows
    LOG.info(
        "%d Gaussians and the rounds of their search need %s in memory, %s are free: they go to scratch files in %s "
        "(at most %s; --scratch names another folder)",
        rows, format_size(plan.held + plan.least), format_size(budget.free), storage.folder, format_size(most),
    )  # fmt: skip
    return storage


def needed_bytes(
    fit: needs.Fit, size: needs.ViewSize, source: SceneSource, poses: int, options: CompressOptions, distils: bool
) -> tuple[int, int]:
    """Bytes that a search with so many scored poses holds in memory, and the least bytes that drawing needs beside them."""
    held, sums = (
        source.count * row_bytes(source.sh_degree, EFFORTS[options.effort].keep, _most_parts(options, poses)),
        sum_row_bytes(source.sh_degree),
    )
    if distils:
        # A descent holds all kept rows at once, with their gradients. That is the whole scene at most.
        sums = max(sums, descent_bytes(source.sh_degree) + needs.plane_bytes(source.sh_degree))
        # The values of all descents take at most three copies of the scene's planes: a strict target keeps more rows, but needs
        # fewer candidates: docs/results/tuning.md#descents
        held += source.count * 3 * stored_bytes(source.sh_degree)
    return held, _least_bytes(fit, size, source, sums, distils)


def _most_parts(options: CompressOptions, poses: int) -> int:
    """Sets that the poses make at most: a search may begin anew with more of them, and then it must fit as well."""
    return MOST_PARTS if options.makes_poses else parts_of(poses)


def least_spilled(renderer: Renderer, source: SceneSource, largest: Camera, distils: bool) -> int:
    """Bytes that the first view of a search in scratch files needs. A view that shows more rows than expected needs more."""
    shown = -(-source.count // renderer.fit.first_share)
    return spilled_bytes(renderer.fit, source, view_size(renderer.backend, largest), shown, distils)


def spilled_bytes(fit: needs.Fit, source: SceneSource, size: needs.ViewSize, shown: int, distils: bool) -> int:
    """Bytes that a view needs in a search in scratch files if it has room for `shown` rows."""
    degree = source.sh_degree

    def least(rows: int, sums: int) -> int:
        return (
            needs.compact_bytes(size, shown, rows, degree) + needs.reference_bytes(size) + needs.sum_bytes(sums) * shown
        )

    pruning = least(min(fit.compact_rows, source.count), needs.MOST_SUMS)
    if not distils:
        return pruning
    rows = streamed_rows(fit, source.count)
    structure = needs.shapes_bytes(needs.structure_shapes(size))
    return max(pruning, least(rows, needs.GRADIENT_SUMS) + structure + streamed_descent_bytes(degree, rows))


def _least_bytes(fit: needs.Fit, size: needs.ViewSize, source: SceneSource, sums: int, structure: bool) -> int:
    """Least bytes that a view of `source` needs, with its reference and `sums` bytes of sums a row; nothing is loaded yet."""
    chunk = needs.padded(min(fit.least_rows, source.count)) * needs.streamed_bytes(source.sh_degree)
    target = needs.reference_bytes(size) + (needs.shapes_bytes(needs.structure_shapes(size)) if structure else 0)
    return needs.view_bytes(size, source.count) + target + sums * source.count + chunk


def stored_bytes(sh_degree: int) -> int:
    """Bytes of a row's stored planes."""
    return sum(4 * field.width(sh_degree) for field in FIELD.values())


def row_bytes(sh_degree: int, keep: float, parts: int = PARTS) -> int:
    """Most bytes that a search holds for each row of its scene, beside those that the renderer counts.

    The larger of two extremes counts. Either the rounds go down to nothing, each keeping `keep` of the one before. Or
    nearly all rows stay: then there is one snapshot, and a candidate made of it. All other searches need less. The sums of
    `parts` sets of poses come on top.

    Making a candidate holds eleven copies of its rows' planes for a moment: rows, codes, twice the values of codes, colours of
    the last refit and of this one, and twice the sums of the refit. With fewer, a scene of which nearly all rows stay would
    exceed its limit: docs/results/tuning.md#work_planes
    """
    planes = stored_bytes(sh_degree)
    snapshot = planes + snapshot_bytes(sh_degree)
    sums = max(parts, PARTS) * 8 * (2 + 4 * sh_degree)
    return round(max(snapshot / (1 - keep), snapshot + 11 * planes)) + sums
