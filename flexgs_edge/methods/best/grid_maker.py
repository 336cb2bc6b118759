"""Makes the candidates for a `.fgs`: what a multiplier keeps, fine-tuned, on its grid, coded and measured."""

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from flexgs_edge.goals.promise import excesses
from flexgs_edge.goals.steps import better
from flexgs_edge.goals.target import Target
from flexgs_edge.grid.grid_scene import GridScene, values_of
from flexgs_edge.grid.step_sizes import StepSizes, holdable
from flexgs_edge.grid.to_grid import lowered, recolour, to_grid
from flexgs_edge.methods.best.allocation import BitModel, Guess, Kept, Measure, Selection, choose
from flexgs_edge.methods.best.choose_steps import Slopes, choose_steps, probe_slopes, reachable
from flexgs_edge.methods.best.costs import RemovalCosts, Snapshot, cost_bytes, measure_costs
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.landing import REACH, land, land_on_quality
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.finetune import Schedule, finetune, structure_of
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.best.search import LARGEST_STRIDE, SLOPE, Candidate, next_point
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.source import MemorySource, Planes

FINE = 2.0**-8
"""Steps as shares of others, where they shall round nothing: of colours before their refit; and of the multiplier that chooses
steps, where the format alone rounds."""
DEAR = 4.0  # A landing leaves Gaussians that cost so many times what their bits are worth


def fits(count: int, first: float = 1.6, last: float = 0.8) -> list[float]:
    """At how many times the Gaussians that a size allows pruning stops for each of so many descents.

    It stops for the `first` one with more than fit, and for the `last` one with fewer: docs/results/tuning.md#interleaved
    """
    return [first * (last / first) ** (k / max(count - 1, 1)) for k in range(count)]


def rate_from(fidelity: float, full: float = 41.0, least: float = 0.25) -> float:
    """Share of the full rates for a descent that starts at `fidelity` dB; it follows the root of the mean squared error.

    With little error left, full steps would break more than they repair: docs/results/tuning.md#rate_from

    `full`: fidelity up to which rates are full, dB. `least`: the least share.
    """
    return max(min(1.0, 10 ** ((full - fidelity) / 20)), least)


Choose = Callable[[RemovalCosts, BitModel, float], tuple[np.ndarray, np.ndarray]]
"""Rows to keep ([n] bool) and their SH degrees ([n] u8), from costs, bits and a multiplier."""


class GridMaker:
    """Makes grids that are coded in container version 2; a `Maker`.

    `see`: scores poses beside these of the views that decide, as `Maker.see`. `selection`: which Gaussians stay. For files of
    another format, `size_of` and `decoded` write the file of a grid and read it back.
    """

    def __init__(
        self,
        rounds: PruneRounds,  # rounds of pruning; more are done when they are needed
        size_of: Callable[[GridScene], int],  # bytes of a grid's file
        measure: Measure,  # quality of planes
        effort: Effort,  # how much work to spend
        refit: bool = True,  # refit the colours of each candidate (default)
        steps: int = 0,  # Views that the descent to a candidate looks at. 0 (default): colours are refitted instead.
        see: Callable[[Sequence[int], int], bool] | None = None,
        decoded: Callable[[GridScene], Planes] | None = None,  # values of a grid's file; `None`: those of the grid
        chosen: Choose = choose,
        bits: BitModel | None = None,
        fixed_rows: bool = False,  # coarser steps save no bytes
        most_colour: float = math.inf,  # constant colours are clipped to this, as SH coefficients
    ) -> None:
        self.rounds, self.size_of, self.measure = rounds, size_of, measure
        self._fixed_rows, self._most_colour = fixed_rows, most_colour
        self._is_file = decoded is not None
        self._decoded = decoded or (lambda grid: values_of(grid, rounds.storage))
        self.effort, self.refit, self.steps, self.close = effort, refit, steps, effort.close
        self.selection = Selection(rounds, effort.keep, chosen, bits or BitModel())
        self._see = see
        self._interleaved = effort.interleaved if steps else 0
        self._slopes: Slopes | None = None
        self._guess = Guess(measure)
        self._mends = math.log(
            effort.finetuned
        )  # by how much a first descent changes the excess; measured, if one is undone
        self._left: dict[int, float] = {}  # Excess that the descent to a snapshot left, by the snapshot's number

    def start(self, target: Target) -> float:
        """Prune and descend in turn, then prune until a candidate is expected to miss."""
        self._interleave(target)
        return self._prune(target)

    def probe(self, multiplier: float, target: Target) -> float:
        """See `Maker`: of the grid of a multiplier, without a refit or a descent of its own."""
        grid = self._before_refit(multiplier)
        if target.limit_bytes is not None:
            # A descent changes the log of the size by about -.035, since bits cost. We aim .02 above the size that was asked
            # for, since results that are too large can be trimmed: docs/results/tuning.md#landing
            return target.excess(self.size_of(grid), None) + (-0.035 if self.steps else 0.0) - 0.02
        return self._after(self._guess(values_of(grid, self.rounds.storage), target))

    def make(self, multiplier: float, target: Target) -> tuple[Candidate, GridScene]:
        """See `Maker`. Where a descent mends nothing, colours are refitted instead, also those of all further candidates."""
        started = time.perf_counter()
        kept, step_sizes = self._choice(multiplier)
        by_size = target.limit_bytes is not None
        grid = self._finetuned(kept, step_sizes, multiplier) if self.steps else self._finish(kept, step_sizes)
        candidate, grid = self._measured(grid, multiplier, target, started, kept.left_out)
        if candidate.excess <= 0.0 or by_size:
            return candidate, grid
        if self.steps and self.refit and not self._is_file:
            before = self._guess(self._grid_values(multiplier), target)
            if before <= candidate.excess:
                self.steps, self.selection.begin = 0, 0
                kept, step_sizes = self._choice(multiplier)
                return self._measured(self._finish(kept, step_sizes), multiplier, target, started, kept.left_out)
        self.selection.missed(kept)
        return candidate, grid

    def trim(
        self, chosen: Candidate, product: GridScene, target: Target, tell: Callable[[Candidate], None], most: int
    ) -> tuple[Candidate, GridScene]:
        """See `Maker`. The constant colours of each are refitted."""
        self.rounds.let_go()  # this goes back to none of them
        best = chosen, product
        found = excesses(target, chosen.size, chosen.measurement)
        if most < 1 or max(found) >= -self.effort.near:
            return best

        def attempt(smaller: GridScene) -> list[float]:
            nonlocal best
            started = time.perf_counter()
            grid = self._with_constants(smaller) if self.refit else smaller
            step, grid = self._measured(grid, chosen.multiplier, target, started, chosen.left_out)
            tell(step)
            if better(step, best[0], target):
                best = step, grid
            return excesses(target, step.size, step.measurement)

        removal, descended = self._removal_costs(product), self.steps > 0
        try:
            land_on_quality(product, removal, found, attempt, self.rounds.storage, most, descended)
        except KeyboardInterrupt:
            if best[0] is chosen:
                raise
        return best

    def see(self, views: Sequence[int]) -> bool:
        """See `Maker`."""
        if self._see is None or not self._see(views, self.selection.begin):
            return False
        self._slopes = None
        return True

    def discard(self, product: GridScene) -> None:
        """Grids go by themselves."""

    def _interleave(self, target: Target) -> None:
        """Prune and descend in turn, as often as the effort says.

        A descent that makes the views that decide worse, or leaves more than the target allows, is undone. If the first one makes
        them worse, colours are refitted instead of all further descents. A descent has half the steps of the one to a candidate,
        and ends at a fifth of its first rates: docs/results/tuning.md#interleaved
        """
        by_size = target.limit_bytes is not None
        for fit in fits(self._interleaved) if by_size else [1.0] * self._interleaved:
            kept = self.selection.kept(self._prune(target, fit))
            pruned = self._fidelity(kept.planes)
            schedule = self._schedule(0.5, pruned, last=0.2)
            self.rounds.renew(partial(self._off_grid, kept, schedule))
            self._slopes, planes, number = None, self.selection.last.planes, len(self.rounds.snapshots) - 1
            worse = self._fidelity(planes) < pruned
            if not by_size:
                self._guess.learn(planes, target)
                self._left[number] = self._guess(planes, target)
            if worse or self._left.get(number, -math.inf) >= 0.0:
                if number in self._left:
                    self._mends = min(self._left.pop(number) - self._guess(kept.planes, target), 0.0)
                self.rounds.undo()
                if worse and self.selection.begin == 0:
                    self.steps = 0
                break
            self.selection.begin = number

    def _prune(self, target: Target, fit: float = 1.0) -> float:
        """Prune until a candidate is expected to miss, or until `fit` times the rows are left that a size allows.

        Returns the multiplier of the candidate that is expected to hold just so.
        """
        limit, points = target.limit_bytes, []

        def enough(last: Snapshot) -> bool:
            if limit is not None:
                return last.count * self.selection.bits.base / 8 <= fit * limit
            # The grid of a cut loses more than the last snapshot. It is not made in rounds far from the answer: those whose
            # snapshot is to lose less than exp(-1.2), three tenths, of what is allowed.
            if len(self.rounds.snapshots) == 1 or self._after(self._guess(last.planes, target)) < -1.2:
                return False
            multiplier = self.selection.cut()
            points.append((math.log(multiplier), self.probe(multiplier, target)))
            return points[-1][1] >= 0.0

        self.selection.prune(enough)
        if not points:
            return self.selection.cut()
        known = self._guess.ssim_margin
        self._guess.learn(self._grid_values(math.exp(points[-1][0])), target)
        self._slopes = None
        more = self._guess.ssim_margin - known
        return math.exp(next_point([(place, excess + more) for place, excess in points], SLOPE, LARGEST_STRIDE))

    def _off_grid(self, kept: Kept, schedule: Schedule) -> tuple[np.ndarray, Planes]:
        """Rows and planes after a descent off the grid."""
        return kept.rows, self._finetune(kept, schedule)

    def _fidelity(self, planes: Planes) -> float:
        """Fidelity of the views that decide, in dB; infinite if all are identical."""
        fidelity = self.measure(planes, estimate=True).figure("fidelity")
        return math.inf if fidelity is None else fidelity

    def _after(self, excess: float) -> float:
        """Expected excess of a candidate after its refit or descent, from that before it."""
        if not self.steps:
            return excess + (math.log(self.effort.refitted) if self.refit else 0.0)
        left = self._left.get(self.selection.begin)
        return excess + self._mends if left is None else (left + excess) / 2

    def _grid_values(self, multiplier: float) -> Planes:
        return values_of(self._before_refit(multiplier), self.rounds.storage)

    def _before_refit(self, multiplier: float) -> GridScene:
        kept, step_sizes = self._choice(multiplier)
        return self._to_grid(kept.planes, kept.degrees, step_sizes)[0]

    def _to_grid(self, planes: Planes, degrees: np.ndarray, step_sizes: StepSizes) -> tuple[GridScene, np.ndarray]:
        return to_grid(planes, degrees, step_sizes, self.rounds.original.origin, storage=self.rounds.storage)

    def _probe_slopes(self, snapshot: Snapshot) -> Slopes:
        original, planes = self.rounds.original, snapshot.planes
        return probe_slopes(original.renderer, planes, original.origin, original.cameras, self.effort.probed)

    def _choice(self, multiplier: float) -> tuple[Kept, StepSizes]:
        """The rows that a multiplier keeps, and the grid's step sizes."""
        kept = self.selection.kept(multiplier)
        snapshot = self.rounds.snapshots[kept.snapshot]
        if self._slopes is None:
            # Measured once, near the answer: slopes change little between snapshots, and step sizes must not jump there.
            self._slopes = self._probe_slopes(snapshot)
        worth = FINE * multiplier if self._fixed_rows else multiplier
        step_sizes = choose_steps(self._slopes, kept.weight2, kept.degrees, len(snapshot.costs.sh), worth)
        count = len(kept.rows)
        kept = kept.take(reachable(step_sizes, kept.planes, kept.weight2 > 0), self.rounds.storage)
        kept.left_out = count - len(kept.rows)
        return kept, holdable(step_sizes, kept.planes)

    def _finetuned(self, kept: Kept, step_sizes: StepSizes, multiplier: float) -> GridScene:
        """Move all values towards the references, put them on the grid, and refit the constant colour.

        As in `_finish`, copies go as soon as they can, those of `kept` as well: a large scene has no room for all of them.
        """
        worth = 0.0 if self._fixed_rows else multiplier
        moved = self._finetune(kept, self._schedule(1.0, self._fidelity(kept.planes), multiplier=worth), step_sizes)
        kept.planes = {}
        grid, _ = self._to_grid(moved, kept.degrees, holdable(step_sizes, moved))
        del moved
        return self._with_constants(grid) if self.refit else grid

    def _finish(self, kept: Kept, step_sizes: StepSizes) -> GridScene:
        """Put geometry on its grid, refit all colours, put SH on their grid, refit the constant colour, put it on its grid."""
        storage, planes = self.rounds.storage, kept.planes
        fine = replace(step_sizes, dc=step_sizes.dc * FINE, sh=tuple(s * FINE for s in step_sizes.sh))
        grid, order = self._to_grid(planes, kept.degrees, holdable(fine, planes))
        kept.planes = planes = {}
        degrees = kept.degrees[order]
        moved = values_of(grid, storage)
        sh = step_sizes.sh[: grid.sh_degree]
        if self.refit:
            if self.effort.refit_rounds:
                moved = self._refit_colours(moved, degrees, self.effort.refit_rounds)
            grid = replace(grid, step_sizes=replace(grid.step_sizes, sh=sh))
            grid = recolour(grid, moved["sh_dc"], moved["sh_rest"], storage)
            del moved
            moved = self._refit_colours(values_of(grid, storage), degrees, 1, bands=False)
            final = replace(grid.step_sizes, dc=step_sizes.dc)
            return recolour(replace(grid, step_sizes=final), moved["sh_dc"], storage=storage)
        final = replace(grid.step_sizes, dc=step_sizes.dc, sh=sh)
        return recolour(replace(grid, step_sizes=final), moved["sh_dc"], moved["sh_rest"], storage)

    def _with_constants(self, grid: GridScene) -> GridScene:
        """The grid with its constant colours refitted once."""
        storage = self.rounds.storage
        moved = self._refit_colours(values_of(grid, storage), grid.sh_degrees, 1, bands=False)
        return recolour(grid, moved["sh_dc"], storage=storage)

    def _measured(
        self, grid: GridScene, multiplier: float, target: Target, started: float, left_out: int
    ) -> tuple[Candidate, GridScene]:
        """Code and measure a grid. One that is a little larger than a size target loses Gaussians first."""
        grid = lowered(grid, self.rounds.storage)
        size, limit = self.size_of(grid), target.limit_bytes
        if limit is not None and 0.0 < math.log(size / limit) <= REACH:
            grid, size = self._landed(grid, size, limit, multiplier)
        measurement = self.measure(self._decoded(grid))
        excess, seconds = target.excess(size, measurement), time.perf_counter() - started
        return Candidate(multiplier, grid.count, grid.sh_count, size, measurement, excess, seconds, left_out), grid

    def _landed(self, grid: GridScene, size: int, limit: int, multiplier: float) -> tuple[GridScene, int]:
        """`land`, and then the constant colours, which had been fitted to what is gone, once more.

        Where a Gaussian costs far more than its bits are worth, a coarser grid is better.
        """
        removal, worth = self._removal_costs(grid), DEAR * multiplier * 8 * size / grid.count
        removal[removal > worth] = np.inf
        landed, less = land(grid, removal, size, limit, self.size_of, self.rounds.storage)
        if landed is grid or not self.refit:
            return landed, less
        mended = self._with_constants(landed)
        final = self.size_of(mended)
        return (mended, final) if final <= limit else (landed, less)

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        """[n] f64, what the removal of each row of a result costs. Behind a descent, those from before it say little.

        Infinite for rows that no scored pose sees: whether they stay is not for a landing to say.
        """
        original = self.rounds.original
        source = MemorySource(values_of(grid, self.rounds.storage), origin=original.origin)
        with original.renderer.load(source, sum_bytes(2) + cost_bytes(0), view_sums=2) as scene:
            costs = measure_costs(original.renderer, scene, original.cameras, sh_costs=False)
        return np.where(costs.weight2 > 0, costs.removal, np.inf)

    def _schedule(
        self, share: float, fidelity: float, last: float = Schedule.last, multiplier: float = 0.0
    ) -> Schedule:
        """A descent with `share` of a candidate's steps, from planes of this fidelity.

        Beyond ten looks at each pose, rates fall with the root of the number: docs/results/tuning.md#full_passes
        """
        passes = self.steps / len(self.rounds.original.cameras)
        rate = min(math.sqrt(10 / passes), 1.0) * rate_from(fidelity)
        return Schedule(math.ceil(share * self.steps), rate, last, multiplier=multiplier)

    def _finetune(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        """A descent; where colours are clipped after it, a second one lets the other values make up for that.

        It has half the steps, at a quarter of the rates: docs/results/tuning.md#clipped
        """

        def descend(planes: Planes, schedule: Schedule) -> Planes:
            weight = structure_of(self._guess.ssim_margin)
            moved = finetune(planes, kept.degrees, self.rounds.original, schedule, step_sizes, structure=weight)
            if self._most_colour < math.inf:
                np.clip(moved["sh_dc"], -self._most_colour, self._most_colour, out=moved["sh_dc"])
            return moved

        moved = descend(kept.planes, schedule)
        if step_sizes is None or self._most_colour == math.inf:
            return moved
        again = replace(schedule, iterations=math.ceil(schedule.iterations / 2), rate=schedule.rate / 4)
        return descend(moved, again)

    def _refit_colours(self, planes: Planes, degrees: np.ndarray, times: int, bands: bool = True) -> Planes:
        subsets = self.effort.subsets_of(len(self.rounds.original.cameras))
        return refit_colours(planes, degrees, self.rounds.original, rounds=times, bands=bands, subsets=subsets)
