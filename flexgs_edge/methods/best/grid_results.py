"""Results on the grid of container version 2: what a multiplier keeps, rounded, mended, coded and measured."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from flexgs_edge.goals.promise import breaks_a_view
from flexgs_edge.goals.target import Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.on_grid import lowered
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import recolour, to_grid
from flexgs_edge.grid.values import values_of
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best import descents
from flexgs_edge.methods.best.candidates import Candidate
from flexgs_edge.methods.best.choose_steps import Slopes, choose_steps, holdable, probe_slopes, reachable
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.kept import Kept, Refitted
from flexgs_edge.methods.best.landing import REACH, land
from flexgs_edge.methods.best.multiplier import Measure, MultiplierSearch
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.distil import LAST, Schedule, distil, structure_of
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.snapshot import Snapshot
from flexgs_edge.methods.best.view_weights import looking_more
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.source import MemorySource, Planes
from flexgs_edge.views.original import Original

FINE_COLOUR = 2.0**-8
"""Step sizes of colours before the refit, as a share of the final ones. They are fine, so that only geometry is rounded."""

NO_COLOURS = np.zeros((3, 0), np.float32)
"""Constant colours before the first descent, and during each."""


class GridResults(MultiplierSearch[GridScene]):
    """Makes the candidates of a search: grids that are coded in container version 2.

    Parameters
    ----------
    rounds : PruneRounds
        Snapshots to choose from.
    size_of : callable
        Bytes of a grid's file.
    measure : callable
        Quality of a grid's decoded planes.
    effort : Effort
        How much work to spend.
    refit : bool
        Refit the colours of each candidate (default).
    on_step : callable, optional
        Called with each candidate.
    steps : int
        Views that the descent to a candidate looks at. 0 (default): colours are refitted instead.
    """

    def __init__(
        self,
        rounds: PruneRounds,
        size_of: Callable[[GridScene], int],
        measure: Measure,
        effort: Effort,
        refit: bool = True,
        on_step: Callable[[Candidate], None] | None = None,
        steps: int = 0,
    ) -> None:
        super().__init__(rounds, measure, effort, on_step)
        self.size_of, self.refit, self.steps = size_of, refit, steps
        if steps:
            self.pruned_part, self.keeps_best = descents.PRUNED_DISTILLED, True
        self._forget()

    def _forget(self) -> None:
        """Begin as if no candidate had been made."""
        self._slopes: Slopes | None = None
        self._refitted: Refitted | None = None
        self._constants = NO_COLOURS  # of the last descent, not rounded, in the order of its grid
        self._looking: Original | None = None  # candidates change how often descents look at its poses

    def _before_refit(self, multiplier: float) -> GridScene:
        kept, step_sizes = self._choice(multiplier)
        return self._to_grid(kept.planes, kept.degrees, step_sizes, self.rounds.storage)[0]

    def _to_grid(
        self, planes: Planes, degrees: np.ndarray, step_sizes: StepSizes, storage: Storage = IN_MEMORY
    ) -> tuple[GridScene, np.ndarray]:
        return to_grid(planes, degrees, step_sizes, self.rounds.original.origin, storage=storage)

    def _probe_slopes(self, snapshot: Snapshot) -> Slopes:
        original, planes = self.rounds.original, snapshot.planes
        return probe_slopes(original.bench.renderer, planes, original.origin, original.cameras, self.effort.probed)

    def _choice(self, multiplier: float) -> tuple[Kept, StepSizes]:
        """The rows that a multiplier keeps, with the colours of the last refit, and the grid's step sizes."""
        kept = self.kept(multiplier)
        if self._refitted is not None:
            kept.planes = self._refitted.apply(kept.rows, kept.degrees, kept.planes, self.rounds.storage)
        snapshot = self.rounds.snapshots[kept.snapshot]
        if self._slopes is None:
            # Measured once, near the answer: slopes change little between snapshots, and step sizes must not jump there.
            self._slopes = self._probe_slopes(snapshot)
        step_sizes = choose_steps(self._slopes, kept.weight2, kept.degrees, len(snapshot.costs.sh), multiplier)
        count = len(kept.rows)
        kept = kept.take(reachable(step_sizes, kept.planes, kept.weight2 > 0), self.rounds.storage)
        kept.left_out = count - len(kept.rows)
        return kept, holdable(step_sizes, kept.planes)

    def _whole(self, multiplier: float, target: Target) -> tuple[Candidate, GridScene]:
        started = time.perf_counter()
        kept, step_sizes = self._choice(multiplier)
        if self.steps:
            schedule = self._schedule(1.0, kept.planes, multiplier=multiplier)
            grid = self._distilled(kept, step_sizes, schedule)
        else:
            grid = self._finish(kept, step_sizes)
        grid = lowered(grid, self.rounds.storage)
        size = self.size_of(grid)
        if target.limit_bytes is not None:
            grid, size = self._landed(grid, size, target.limit_bytes)
        candidate = self._measured(grid, size, multiplier, target, started, kept.left_out)
        if breaks_a_view(target, candidate.measurement):
            self._looking = looking_more(self._looking or self.rounds.original, candidate.measurement.losses)
        return candidate, grid

    def _distilled(self, kept: Kept, step_sizes: StepSizes, schedule: Schedule) -> GridScene:
        """Move all values towards the references, put them on the grid, and refit the constant colour.

        As in `_finish`, copies go as soon as they can, those of `kept` as well: a large scene has no room for all of them.
        """
        self._constants = NO_COLOURS  # a descent has no room for those of the last one
        moved = self._distil(kept, schedule, step_sizes)
        kept.planes = {}
        grid, order = self._to_grid(moved, kept.degrees, holdable(step_sizes, moved), self.rounds.storage)
        self._constants = self.rounds.storage.take(moved["sh_dc"], order)
        del moved
        return self._with_constants(grid) if self.refit else grid

    def _finish(self, kept: Kept, step_sizes: StepSizes) -> GridScene:
        """Put geometry on its grid, refit all colours, put SH on their grid, refit the constant colour, put it on its grid."""
        storage, planes = self.rounds.storage, kept.planes
        fine = replace(step_sizes, dc=step_sizes.dc * FINE_COLOUR, sh=tuple(s * FINE_COLOUR for s in step_sizes.sh))
        fine = holdable(fine, planes)
        grid, order = self._to_grid(planes, kept.degrees, fine, storage)
        kept.planes = planes = {}
        degrees = kept.degrees[order]
        moved = values_of(grid, storage)
        if self.refit:
            if self.effort.refit_rounds:
                moved = self._refit_colours(moved, degrees, self.effort.refit_rounds)
                self._refitted = Refitted.of(kept.rows, kept.degrees, order, moved, storage)
            grid = replace(grid, step_sizes=replace(grid.step_sizes, sh=step_sizes.sh[: grid.sh_degree]))
            grid = recolour(grid, moved["sh_dc"], moved["sh_rest"], storage)
            del moved
            moved = self._refit_colours(values_of(grid, storage), degrees, 1, bands=False)
            final = replace(grid.step_sizes, dc=step_sizes.dc)
            return recolour(replace(grid, step_sizes=final), moved["sh_dc"], storage=storage)
        final = replace(grid.step_sizes, dc=step_sizes.dc, sh=step_sizes.sh[: grid.sh_degree])
        return recolour(replace(grid, step_sizes=final), moved["sh_dc"], moved["sh_rest"], storage)

    def _with_constants(self, grid: GridScene) -> GridScene:
        """The grid with its constant colours refitted once."""
        storage = self.rounds.storage
        moved = self._refit_colours(values_of(grid, storage), grid.sh_degrees, 1, bands=False)
        return recolour(grid, moved["sh_dc"], storage=storage)

    def _with_finer_constants(self, grid: GridScene, factor: float) -> GridScene:
        """The last descent's grid with constant colours in steps `factor` times as large, from values that were not rounded."""
        step_sizes = replace(grid.step_sizes, dc=factor * grid.step_sizes.dc)
        finer = recolour(replace(grid, step_sizes=step_sizes), self._constants, storage=self.rounds.storage)
        return self._with_constants(finer) if self.refit else finer

    def _landed(self, grid: GridScene, size: int, limit: int) -> tuple[GridScene, int]:
        """`land`, and then the constant colours, which had been fitted to what is gone, once more."""
        storage = self.rounds.storage
        if not 0.0 < math.log(size / limit) <= REACH:
            return grid, size
        landed, less = land(grid, self._removal_costs(grid), size, limit, self.size_of, storage)
        if landed is grid or not self.refit:
            return landed, less
        mended = self._with_constants(landed)
        final = self.size_of(mended)
        return (mended, final) if final <= limit else (landed, less)

    def _measured(
        self, grid: GridScene, size: int, multiplier: float, target: Target, started: float, left_out: int
    ) -> Candidate:
        measurement = self.measure(values_of(grid, self.rounds.storage))
        excess, seconds = target.excess(size, measurement), time.perf_counter() - started
        return Candidate(multiplier, grid.count, grid.sh_count, size, measurement, excess, seconds, left_out)

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        """[n] f64, what the removal of each row of a result costs. Behind a descent, those from before it say little.

        Infinite for rows that no scored pose sees: whether they stay is not for a landing to say.
        """
        original = self.rounds.original
        source = MemorySource(values_of(grid, self.rounds.storage), origin=original.origin)
        with original.bench.renderer.load(source, sum_bytes(2) + cost_bytes(0), view_sums=2) as scene:
            costs = measure_costs(original.bench, scene, original.cameras, sh_costs=False)
        return np.where(costs.weight2 > 0, costs.removal, np.inf)

    def _schedule(self, share: float, planes: Planes, last: float = LAST, multiplier: float = 0.0) -> Schedule:
        """A descent from these planes with `share` of a candidate's steps."""
        fidelity = self.measure(planes, estimate=True).figure("fidelity")
        return self._descents.schedule(share, fidelity, last, multiplier)

    @property
    def _descents(self) -> descents.Descents:
        return descents.Descents(self.steps, len(self.rounds.original.cameras), self._lead)

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        original, weight = self._looking or self.rounds.original, structure_of(self._lead)
        return distil(kept.planes, kept.degrees, original, schedule, step_sizes, structure=weight)

    def _refit_colours(self, planes: Planes, degrees: np.ndarray, times: int, bands: bool = True) -> Planes:
        subsets = self.effort.subsets_of(len(self.rounds.original.cameras))
        return refit_colours(planes, degrees, self.rounds.original, rounds=times, bands=bands, subsets=subsets)
