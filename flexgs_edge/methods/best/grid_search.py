"""The search for a `.fgs`: candidates at different multipliers, each refitted, coded and measured.

A candidate is a finished result (`grid_results`). Probes are cheaper results without a refit. They tell where the next
candidate should lie.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.goals.line import AIM, next_point
from flexgs_edge.goals.promise import bounds_ssim, excesses
from flexgs_edge.goals.steps import better
from flexgs_edge.goals.target import Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.values import values_of
from flexgs_edge.methods.best import descents
from flexgs_edge.methods.best.candidates import LARGEST_STRIDE, SIZE_SLOPE, SLOPE, Candidate, RateResult, bounds, misses
from flexgs_edge.methods.best.grid_results import GridResults
from flexgs_edge.methods.best.landing import NEAR_QUALITY, land_on_quality
from flexgs_edge.methods.best.multiplier import LOG, PRUNED_PART

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
NEAR_MISS, FINER = 0.07, (0.8, 0.64)
"""Largest log by which a descent's result may miss to be tried with finer steps of its constant colours, and factors of these:
docs/results/tuning.md#near_miss"""
DECAY = 0.8
"""Share of the last drift that the next refit adds again. It is above zero because refits overfit the scored poses:
docs/results/tuning.md#decay"""
FARTHER = 0.05
"""How much farther below the target we aim for each candidate in a row that missed it: docs/results/tuning.md#follow"""
PROBES = 4
"""Most probes between two candidates."""
FARTHEST = 2.0
"""Largest change of the log of the multiplier by all probes of one aim."""


class GridSearch(GridResults):
    """The search for the grid whose file meets a target: where the next candidate should lie, and when it is enough.

    Parameters are those of `GridResults`.
    """

    def _forget(self) -> None:
        super()._forget()
        # Without a refit of SH, a candidate takes nothing over from the one before. Descents begin anew as well.
        self._drift, self._expected = DRIFT if self.effort.refit_rounds and not self.steps else 0.0, 0.0
        self._interleaved, self._left = self.effort.interleaved if self.steps else 0, 0.0

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
        self.steps, self.pruned_part, self.keeps_best, self._begin = 0, PRUNED_PART, False, 0
        self._forget()
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

    def _landed_on_quality(self, found: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
        """The answer without the Gaussians that it could do without."""
        self.rounds.let_go()  # a landing goes back to none of them
        steps = list(found.steps)
        best = self._thinned(found.chosen, found.product, target, steps)
        return replace(found, product=best[1], chosen=best[0], steps=tuple(steps))

    def _mended(
        self, missed: Candidate, product: GridScene, target: Target, tried: list[Candidate]
    ) -> tuple[Candidate, GridScene] | None:
        if target.limit_bytes is None and self.steps and missed.excess <= NEAR_MISS:
            return self._with_finer(missed, product, target, tried)
        return None

    def _with_finer(
        self, missed: Candidate, product: GridScene, target: Target, tried: list[Candidate]
    ) -> tuple[Candidate, GridScene] | None:
        """The last descent's result with finer steps of constant colours, if it holds.

        If a factor gains less than half of the miss, the next ones are not tried.
        """
        for factor in FINER:
            started = time.perf_counter()
            try:
                grid = self._with_finer_constants(product, factor)
                step = self._variant(grid, missed, target, tried, started)
            except KeyboardInterrupt:
                if not self.keeps_best:
                    raise
                self.interrupted()
                break
            if step.holds:
                return step, grid
            if step.excess > missed.excess / 2:
                break
        return None

    def _variant(
        self, grid: GridScene, of: Candidate, target: Target, tried: list[Candidate], started: float
    ) -> Candidate:
        """Code and measure a grid that was made of a candidate's, from `started` on."""
        step = self._measured(grid, self.size_of(grid), of.multiplier, target, started, of.left_out)
        tried.append(step)
        if self.on_step:
            self.on_step(step)
        return step

    def _thinned(
        self, chosen: Candidate, grid: GridScene, target: Target, steps: list[Candidate]
    ) -> tuple[Candidate, GridScene]:
        """The best of a result and what is left of it when the cheapest Gaussians go until the target hardly holds."""
        best = chosen, grid

        def attempt(smaller: GridScene) -> list[float]:
            nonlocal best
            started = time.perf_counter()
            mended = self._with_constants(smaller) if self.refit else smaller
            step = self._variant(mended, chosen, target, steps, started)
            if better(step, best[0], target):
                best = step, mended
            return excesses(target, step.size, step.measurement)

        found = excesses(target, chosen.size, chosen.measurement)
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
