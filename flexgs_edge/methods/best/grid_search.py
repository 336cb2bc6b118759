"""The search for a `.fgs`: candidates at different multipliers, each refitted, coded and measured.

A candidate is a finished result: geometry on its grid, colours refitted, bytes counted, quality measured. Probes are
cheaper results without a refit. They tell where the next candidate should lie.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.goals.line import AIM, next_point
from flexgs_edge.goals.promise import bounds_ssim, breaks_a_view, excesses, means
from flexgs_edge.goals.steps import better
from flexgs_edge.goals.target import Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.on_grid import lowered
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import recolour, to_grid
from flexgs_edge.grid.values import values_of
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best import descents
from flexgs_edge.methods.best.candidates import LARGEST_STRIDE, SIZE_SLOPE, SLOPE, Candidate, RateResult, bounds, misses
from flexgs_edge.methods.best.choose_steps import Slopes, choose_steps, holdable, probe_slopes, reachable
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.kept import Kept, Refitted
from flexgs_edge.methods.best.landing import NEAR_QUALITY, REACH, land, land_on_quality
from flexgs_edge.methods.best.layers import first_layer
from flexgs_edge.methods.best.multiplier import LOG, PRUNED_PART, Measure, MultiplierSearch
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.distil import LAST, Schedule, distil, structure_of
from flexgs_edge.methods.best.rounds import PruneRounds, Snapshot
from flexgs_edge.methods.best.view_weights import looking_more
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.scene.source import MemorySource, Planes
from flexgs_edge.views.original import Original

FINE_COLOUR = 2.0**-8
"""Step sizes of colours before the refit, as a share of the final ones. They are fine, so that only geometry is rounded."""
FURTHER = 0.92
"""Loss after a further round of the colour refit, divided by the loss before it: docs/results/tuning.md#further"""
DRIFT = -0.12
"""Change of the excess by a second refit, which goes on where the first one ended: docs/results/tuning.md#drift"""
PRICED = -0.035
"""Expected log of the size after a descent over that before it, below 0 since bits cost: docs/results/tuning.md#landing"""
ABOVE = 0.02
"""How far above a size we aim, since results that are too large can be landed: docs/results/tuning.md#landing"""
CLOSE_SIZE = 0.003
"""A candidate that is smaller than asked by no more than this ends the search."""
ROOM = 0.1
"""How far below what is asked the means must be for a result to lose Gaussians although its worst view misses:
docs/results/tuning.md#room"""
DECAY = 0.8
"""Share of the last drift that the next refit adds again. It is above zero because refits overfit the scored poses:
docs/results/tuning.md#decay"""
FARTHER = 0.05
"""How much farther below the target we aim for each candidate in a row that missed it: docs/results/tuning.md#follow"""
PROBES = 4
"""Most probes between two candidates."""
FARTHEST = 2.0
"""Largest change of the log of the multiplier by all probes of one aim."""


class GridSearch(MultiplierSearch[GridScene]):
    """The search for the grid that is coded in container version 2.

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
    first : float
        Share of the bits that a first layer gets. Descents to candidates draw it alone, too. 0 (default): there is none.
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
        first: float = 0.0,
    ) -> None:
        super().__init__(rounds, measure, effort, on_step)
        self.size_of, self.refit, self.steps, self.first = size_of, refit, steps, first
        if steps:
            self.pruned_part, self.keeps_best = descents.PRUNED_DISTILLED, True
        self._slopes: Slopes | None = None
        self._refitted: Refitted | None = None
        # Without a refit of SH, a candidate takes nothing over from the one before. Descents begin anew as well.
        self._drift, self._expected = DRIFT if effort.refit_rounds and not steps else 0.0, 0.0
        self._looking: Original | None = None  # candidates change how often descents look at its poses
        self._interleaved, self._left = effort.interleaved if steps else 0, 0.0

    def run(self, target: Target, best_effort: bool = False) -> RateResult[GridScene]:
        """As `MultiplierSearch.run`, and then `land_on_quality` if a quality is asked for."""
        found = self._searched(target, best_effort)
        lands = found.reached and target.limit_bytes is None and not self.ended
        return self._landed_on_quality(found, target) if lands else found

    def _searched(self, target: Target, best_effort: bool) -> RateResult[GridScene]:
        """As `MultiplierSearch.run`. Where no descent reaches a quality, colours are refitted instead.

        Descents gain most in the mean, so that the worst view may never come near enough to it.
        """
        if not (self.steps and self.refit) or target.limit_bytes is not None:
            return super().run(target, best_effort)
        found = super().run(target, best_effort=True)
        if not found.reached and self._has_all_left(found.chosen):
            LOG.info("the descents between the rounds left too few Gaussians: descending from more")
            self._interleaved, self._begin, self._left, self._slopes = 0, 0, 0.0, None
            found = self._also(found, super().run(target, best_effort=True), target)
        if found.reached:
            return found
        LOG.info("no descent reaches the target: colours are refitted instead")
        self._interleaved, self._begin, self._left = 0, 0, 0.0
        self.steps, self.pruned_part, self.keeps_best = 0, PRUNED_PART, False
        self._refitted, self._slopes, self._drift = None, None, DRIFT if self.effort.refit_rounds else 0.0
        return self._also(found, super().run(target, best_effort), target)

    @staticmethod
    def _also(one: RateResult[GridScene], other: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
        """The better one of two results, with the candidates of both."""
        best = other if better(other.chosen, one.chosen, target) else one
        return replace(best, steps=(*one.steps, *other.steps))

    def _close(self, target: Target) -> float:
        return super()._close(target) if target.limit_bytes is None else CLOSE_SIZE

    def _used_up(self, steps: Sequence[Candidate]) -> bool:
        """Also if the last two have nearly all that the descents between the rounds left, and finer steps gain little."""
        last = steps[-2:]
        if len(last) == 2 and all(map(self._has_all_left, last)) and last[1].excess > descents.NEAR_TARGET:
            finer = math.log(last[0].multiplier / last[1].multiplier)
            if last[0].excess - last[1].excess < descents.LEAST_STEPS_SLOPE * finer:
                return True
        return super()._used_up(steps)

    def _has_all_left(self, step: Candidate) -> bool:
        """Whether a candidate has nearly all Gaussians that the descents between the rounds have left."""
        return self._begin > 0 and step.count >= descents.ALL_LEFT * self.rounds.snapshots[self._begin].count

    def _start(self, target: Target) -> float:
        self._interleave(target)
        return super()._start(target)

    def _interleave(self, target: Target) -> None:
        """Prune and descend in turn, until descents mend too little, or as few Gaussians are left as a size asks for."""
        by_size, after = target.limit_bytes is not None, -math.inf
        for fit in descents.fits(self._interleaved) if by_size else [1.0] * self._interleaved:
            self._prune(target, self.effort.interleave_at, fit)
            self._descend_between()
            last, before = len(self.rounds.snapshots) - 1, after
            if not by_size:
                planes = self.rounds.snapshots[last].planes
                if bounds_ssim(target):
                    self._learn_lead(planes, target)
                after = self._guess(planes, target)
                if after >= math.log(descents.MOST_LEFT):
                    break
                self._left = after
            self._begin = last
            # One alone may leave more by chance.
            if min(before, after) >= math.log(descents.INTERLEAVE_TO):
                break

    def _descend_between(self) -> None:
        """Cut half a round, and descend off the grid from what is left."""

        def change() -> tuple[np.ndarray, dict[str, np.ndarray]]:
            kept = self.kept(self._cut(self.rounds.snapshots[-1]))
            schedule = self._schedule(descents.INTERLEAVED_SHARE, kept.planes, last=descents.INTERLEAVED_LAST)
            return kept.rows, self._distil(kept, schedule)

        self.rounds.renew(change)

    def _schedule(self, share: float, planes: Planes, last: float = LAST, multiplier: float = 0.0) -> Schedule:
        """A descent from these planes with `share` of a candidate's steps."""
        fidelity = self.measure(planes, estimate=True).figure("fidelity")
        return self._descents.schedule(share, fidelity, last, multiplier)

    @property
    def _descents(self) -> descents.Descents:
        return descents.Descents(self.steps, len(self.rounds.original.cameras), self._lead)

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

    def _distil(self, kept: Kept, schedule: Schedule, step_sizes: StepSizes | None = None) -> Planes:
        original, layered = self._looking or self.rounds.original, self.first and step_sizes is not None
        first = first_layer(kept.planes, kept.degrees, self.first, self.bits, original) if layered else None
        weight = structure_of(self._lead)
        return distil(kept.planes, kept.degrees, original, schedule, step_sizes, structure=weight, first=first)

    def _refit_colours(self, planes: Planes, degrees: np.ndarray, times: int, bands: bool = True) -> Planes:
        subsets = self.effort.subsets_of(len(self.rounds.original.cameras))
        return refit_colours(planes, degrees, self.rounds.original, rounds=times, bands=bands, subsets=subsets)

    def _probe(self, multiplier: float, target: Target) -> float:
        """Excess of a probe: the grid of a multiplier, without a refit of its own."""
        grid = self._before_refit(multiplier)
        if target.limit_bytes is not None:
            return target.excess(self.size_of(grid), None)
        return self._guess(values_of(grid, self.rounds.storage), target)

    def _aim(self, multiplier: float, steps: Sequence[Candidate], target: Target) -> float:
        """Probe for the multiplier whose candidate should be just below the target. A refit changes the excess alike nearby."""
        by_size = target.limit_bytes is not None
        if steps and self.steps and not by_size:
            return self._follow(multiplier, steps)
        first, slope = self.refit and not (steps or by_size), SIZE_SLOPE if by_size else SLOPE
        # A result that is a little too large can be landed, one that is too small cannot.
        offset = (PRICED if self.steps else 0.0) - ABOVE if by_size else 0.0
        if steps:
            offset = steps[-1].excess - self._probe(steps[-1].multiplier, target)
            if by_size and steps[-1].holds:
                offset -= ABOVE
            if self.refit and not by_size:
                # Probes have the colours of the last refit, and the next refit goes on from these.
                if len(steps) > 1:
                    self._drift = DECAY * (self._drift + steps[-1].excess - self._expected)
                # If candidates keep missing, for whatever reason, aim farther each time.
                offset += self._drift + FARTHER * max(misses(steps) - 1, 0)
        elif not by_size and bounds_ssim(target):
            self._learn_lead(values_of(self._before_refit(multiplier), self.rounds.storage), target)
        low, high = bounds(steps, by_size)
        place = min(max(math.log(multiplier), low), high)
        if math.isfinite(high - low):
            # The line between two whole results is better than probes, whose colours make up for missing rows.
            self._expected = AIM
            return math.exp(place)
        # If nothing holds and the curve is flat, the search must not run away to infinity.
        ends = max(low, place - FARTHEST), min(high, place + FARTHEST)
        expect = self._after_first if first else (lambda excess: excess + offset)
        place = self._probed(place, expect, ends, slope, target)
        if self.steps and not (steps or by_size or self._begin):
            piloted = self._piloted(math.exp(place), target)
            place = self._probed(place, lambda excess: excess + piloted, ends, slope, target)
        return math.exp(place)

    def _follow(self, multiplier: float, steps: Sequence[Candidate]) -> float:
        """The multiplier after descents. They mend the more, the more a probe loses, so that whole results tell more."""
        low, high = bounds(steps, by_size=False)
        place = min(max(math.log(multiplier), low), high)
        if math.isfinite(high - low):
            return math.exp(place)
        last, farther = steps[-1], FARTHER * misses(steps)
        if last.holds or not self._has_all_left(last):
            return math.exp(place - farther / SLOPE)
        return last.multiplier * math.exp((AIM - last.excess - farther) / descents.STEPS_SLOPE)

    def _probed(
        self, place: float, expect: Callable[[float], float], ends: tuple[float, float], slope: float, target: Target
    ) -> float:
        """Log of the multiplier, between `ends`, from whose probe we `expect` a candidate just below the target."""
        seen: list[tuple[float, float]] = []
        self._expected = AIM
        for _ in range(PROBES):
            excess = expect(self._probe(math.exp(place), target))
            if abs(excess - AIM) < -AIM:
                self._expected = excess
                break
            seen.append((place, excess))
            there, place = place, min(max(next_point(seen, slope, LARGEST_STRIDE), ends[0]), ends[1])
            if place == there:
                break
        return place

    def _piloted(self, multiplier: float, target: Target) -> float:
        """Expected change of the excess by a descent, learned from a pilot. Scenes differ too much for a constant."""
        kept, step_sizes = self._choice(multiplier)
        schedule = self._schedule(descents.PILOT, kept.planes, multiplier=multiplier)
        grid = self._distilled(kept, step_sizes, schedule)
        found = target.excess(0, self.measure(values_of(grid, self.rounds.storage)))
        return found - self._probe(multiplier, target) - descents.PILOT_POWER * math.log(descents.PILOT)

    def _after_first(self, excess: float) -> float:
        """Expected excess after the first candidate's refit or descent, from that before it."""
        if self.steps:
            return self._descents.after(excess, self._left if self._begin else None)
        return excess + math.log(self.effort.refitted * FURTHER ** (self.effort.refit_rounds - 1))

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

    def _measured(
        self, grid: GridScene, size: int, multiplier: float, target: Target, started: float, left_out: int
    ) -> Candidate:
        measurement = self.measure(values_of(grid, self.rounds.storage))
        excess, seconds = target.excess(size, measurement), time.perf_counter() - started
        return Candidate(multiplier, grid.count, grid.sh_count, size, measurement, excess, seconds, left_out)

    def _distilled(self, kept: Kept, step_sizes: StepSizes, schedule: Schedule) -> GridScene:
        """Move all values towards the references, put them on the grid, and refit the constant colour."""
        moved = self._distil(kept, schedule, step_sizes)
        grid = self._to_grid(moved, kept.degrees, holdable(step_sizes, moved), self.rounds.storage)[0]
        return self._with_constants(grid) if self.refit else grid

    def _with_constants(self, grid: GridScene) -> GridScene:
        """The grid with its constant colours refitted once."""
        storage = self.rounds.storage
        moved = self._refit_colours(values_of(grid, storage), grid.sh_degrees, 1, bands=False)
        return recolour(grid, moved["sh_dc"], moved["sh_rest"], storage)

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        """[n] f64, what the removal of each row of a result costs. Behind a descent, those from before it say little.

        Infinite for rows that no scored pose sees: whether they stay is not for a landing to say.
        """
        original = self.rounds.original
        source = MemorySource(values_of(grid, self.rounds.storage), origin=original.origin)
        with original.bench.renderer.load(source, sum_bytes(2) + cost_bytes(0), view_sums=2) as scene:
            costs = measure_costs(original.bench, scene, original.cameras, sh_costs=False)
        return np.where(costs.weight2 > 0, costs.removal, np.inf)

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

    def _landed_on_quality(self, found: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
        """The answer without the Gaussians that it could do without."""
        steps = list(found.steps)
        best = self._thinned(found.chosen, found.product, target, target, steps)
        return replace(found, product=best[1], chosen=best[0], steps=tuple(steps))

    def _mended(
        self, missed: Candidate, product: GridScene, target: Target, tried: list[Candidate]
    ) -> tuple[Candidate, GridScene] | None:
        """With fewer Gaussians, if only the worst view misses while the means are far better than asked.

        The bound on the worst view grows with the mean, so that a finer result would miss it as well.
        """
        if target.limit_bytes is not None or means(target).excess(missed.size, missed.measurement) > -ROOM:
            return None
        step, grid = self._thinned(missed, product, target, means(target), tried)
        return (step, grid) if step.holds else None

    def _thinned(
        self, chosen: Candidate, grid: GridScene, target: Target, goal: Target, steps: list[Candidate]
    ) -> tuple[Candidate, GridScene]:
        """The best of a result and what is left of it when the cheapest Gaussians go until `goal` hardly holds."""
        best = chosen, grid

        def attempt(smaller: GridScene) -> list[float]:
            nonlocal best
            started = time.perf_counter()
            mended = self._with_constants(smaller) if self.refit else smaller
            step = self._measured(mended, self.size_of(mended), chosen.multiplier, target, started, chosen.left_out)
            steps.append(step)
            if self.on_step:
                self.on_step(step)
            if better(step, best[0], target):
                best = step, mended
            return excesses(goal, step.size, step.measurement)

        found = excesses(goal, chosen.size, chosen.measurement)
        if max(found) >= -NEAR_QUALITY:
            return best
        try:
            removal = self._removal_costs(grid)
            land_on_quality(grid, removal, found, attempt, self.rounds.storage, descended=self.steps > 0)
        except KeyboardInterrupt:
            if not self.keeps_best:
                raise
            self.interrupted()
        return best

    def _finish(self, kept: Kept, step_sizes: StepSizes) -> GridScene:
        """Put geometry on its grid, refit all colours, put SH on their grid, refit the constant colour, put it on its grid."""
        storage, planes = self.rounds.storage, kept.planes
        fine = replace(step_sizes, dc=step_sizes.dc * FINE_COLOUR, sh=tuple(s * FINE_COLOUR for s in step_sizes.sh))
        fine = holdable(fine, planes)
        grid, order = self._to_grid(planes, kept.degrees, fine, storage)
        degrees = kept.degrees[order]
        moved = values_of(grid, storage)
        if self.refit:
            if self.effort.refit_rounds:
                moved = self._refit_colours(moved, degrees, self.effort.refit_rounds)
                self._refitted = Refitted.of(kept.rows, kept.degrees, order, moved, storage)
            grid = replace(grid, step_sizes=replace(grid.step_sizes, sh=step_sizes.sh[: grid.sh_degree]))
            coarse = values_of(recolour(grid, moved["sh_dc"], moved["sh_rest"], storage), storage)
            moved = self._refit_colours(coarse, degrees, 1, bands=False)
        final = replace(grid.step_sizes, dc=step_sizes.dc, sh=step_sizes.sh[: grid.sh_degree])
        return recolour(replace(grid, step_sizes=final), moved["sh_dc"], moved["sh_rest"], storage)
