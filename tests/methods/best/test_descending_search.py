"""The search with descents to its candidates, and with descents between the rounds of pruning."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flexgs_edge.goals.promise import MeanSsim, Promised
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.values import values_of
from flexgs_edge.methods.best import descents, grid_results, grid_search
from flexgs_edge.methods.best.candidates import Candidate, RateResult
from flexgs_edge.methods.best.descents import (
    BEHIND_LONG,
    BEHIND_SHORT,
    DISTILLED,
    DISTILLED_POWER,
    FIT_DESCENTS,
    FULL_PASSES,
    INTERLEAVE_TO,
    INTERLEAVED_LAST,
    LEAST_FIT,
    MOST_FIT,
    MOST_LEFT,
    PILOT,
    PILOT_POWER,
    fits,
    rate_from,
)
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.best.kept import Kept
from flexgs_edge.methods.best.refit.distil import STRUCTURE, Schedule
from flexgs_edge.methods.best.rounds import take_rows
from known_search import AT, BYTES, EFFORT, FakeRounds, KnownSearch, World, powers, search


def test_descents_with_less_to_mend_go_at_smaller_rates() -> None:
    assert rate_from(30.0) == rate_from(41.0) == rate_from(None) == 1.0
    assert rate_from(47.0) == pytest.approx(0.5, abs=0.002)  # half the error of 41 dB
    assert rate_from(53.0) == pytest.approx(0.25, abs=0.002) and rate_from(90.0) == 0.25


@pytest.mark.parametrize(("passes", "behind"), [(FULL_PASSES, BEHIND_LONG), (FULL_PASSES // 2, BEHIND_SHORT)])
def test_a_candidate_behind_descents_ends_halfway_between_what_they_left_and_its_probe(
    passes: int, behind: float
) -> None:
    rounds = FakeRounds()
    steps = passes * len(rounds.original.cameras)
    finder = KnownSearch(rounds, lambda _: 0, lambda *_: None, EFFORT, steps=steps)  # type: ignore[arg-type]
    assert finder._after_first(0.1) == pytest.approx(0.1 + math.log(DISTILLED * passes**DISTILLED_POWER))
    finder._begin, finder._left = 1, -0.2
    assert finder._after_first(0.4) == pytest.approx(0.1 + behind)


def test_the_last_descent_before_a_size_has_about_the_rows_that_fit() -> None:
    assert fits(20) == fits(FIT_DESCENTS) and fits(2) == [MOST_FIT, LEAST_FIT] and fits(1) == [MOST_FIT] and not fits(0)
    assert sorted(fits(5), reverse=True) == fits(5)


class Mending(KnownSearch):
    """Descents to candidates mark opacities; `calls` has the steps, rate and first opacity of each."""

    calls: list[tuple[int, float, float]]

    def _distil(self, kept: Kept, schedule: Schedule, steps: StepSizes | None = None) -> Any:
        if steps is None:
            return super()._distil(kept, schedule)
        logits = kept.planes["opacity_logits"]
        self.calls.append((schedule.iterations, schedule.rate, float(logits.max())))
        return {**kept.planes, "opacity_logits": np.full_like(logits, MARK)}

    def _refit_colours(self, planes: Any, *_: Any, **__: Any) -> Any:
        return planes

    def _with_finer(self, *_: Any) -> Any:
        return None


MARK = 9.0
"""Opacity logit of what a descent has moved."""


class Mended(World):
    """What a descent has marked loses `part` as much. Nothing is so near the original that descents go at smaller rates."""

    def __init__(self, part: float, expected: float, ssim: float | None = None) -> None:
        super().__init__(lambda m: (m / AT) ** 0.6 / expected, lambda m: BYTES * (m / AT) ** -0.45)
        self.part, self.ssim = part, ssim

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        descended = bool((planes["opacity_logits"] > MARK - 0.5).all())
        drop = (super().measure(planes, estimate).drop or 0.0) * (self.part if descended else 1.0)
        return Measurement(drop, 30.0, drop, ssim_drop=None if estimate or self.ssim is None else self.ssim * drop)


@pytest.mark.parametrize("part", [0.1, 0.2, 0.5])
def test_a_pilot_tells_how_much_descents_mend(part: float) -> None:
    """Half the steps, then candidates of all steps, each from the beginning; the first one is near, whatever a descent mends."""
    expected = DISTILLED * 10**DISTILLED_POWER
    assert FULL_PASSES >= 10
    Mending.calls = calls = []
    result = search(Mended(part, expected), MaxDrop(1.0), kind=Mending, refit=True, steps=100)
    assert result.reached and [steps for steps, *_ in calls] == [50] + [100] * len(result.steps)
    assert all(rate == 1.0 and before < MARK - 0.5 for _, rate, before in calls)
    # The pilot of this world mends as much as a whole descent, from which more is expected.
    assert abs(result.steps[0].excess - PILOT_POWER * math.log(PILOT)) < 0.1


def test_a_size_needs_no_pilot() -> None:
    Mending.calls = calls = []
    result = search(Mended(0.3, 0.3), MaxSize(3000), kind=Mending, refit=True, steps=100)
    assert result.reached and [steps for steps, *_ in calls] == [100] * len(result.steps)


def test_a_size_that_is_missed_with_all_rows_is_met_by_coarser_steps() -> None:
    """For a quality such a candidate would end the search."""

    class Grown(Mended):
        def size_of(self, grid: GridScene) -> int:
            return round(super().size_of(grid) * (1.5 if (grid.opacity == grid.opacity.max()).all() else 1.0))

    class AllLeft(Mending):
        def _has_all_left(self, step: Candidate) -> bool:
            return True

    Mending.calls = []
    result = search(Grown(0.3, 0.3), MaxSize(3000), kind=AllLeft, refit=True, steps=100)
    assert result.reached and not result.steps[0].holds and len(result.steps) > 1


@pytest.mark.parametrize("ssim", [0.001, 0.03])
def test_the_first_candidate_aims_at_ssim_where_it_is_nearer(ssim: float) -> None:
    world = Mended(1.0, 1.0, ssim)
    target = Promised(MaxDrop(1.0), (MeanSsim(0.015),))
    first = search(world, target, kind=Mending, refit=False, steps=0).steps[0]
    assert abs(first.excess) < 0.1 and (first.measurement.drop or 0.0) == pytest.approx(min(1.0, 0.015 / ssim), rel=0.1)


def test_a_mended_result_does_not_take_the_place_of_a_smaller_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor is anything lost by an interruption while a result is mended."""
    quality = Measurement(0.3, 30.0, 0.3)
    given = iter([Candidate(1.0, 9, 0, 100, quality, -0.5, 0.0), Candidate(2.0, 8, 0, 90, quality, 0.1, 0.0)])
    finder = KnownSearch(FakeRounds(), lambda _: 0, lambda *_: quality, EFFORT)  # type: ignore[arg-type]
    monkeypatch.setattr(finder, "_start", lambda _: 1.0)
    monkeypatch.setattr(finder, "_aim", lambda multiplier, *_: multiplier)
    monkeypatch.setattr(finder, "_whole", lambda *_: (next(given), object()))
    monkeypatch.setattr(finder, "_thinned", lambda chosen, grid, *_: (chosen, grid))
    larger = Candidate(2.0, 8, 0, 110, quality, -0.01, 0.0)
    monkeypatch.setattr(finder, "_mended", lambda *_: (larger, object()))
    assert finder.run(MaxDrop(0.5)).chosen.size == 100
    again = iter([Candidate(1.0, 9, 0, 100, quality, 0.4, 0.0)])
    monkeypatch.setattr(finder, "_whole", lambda *_: (next(again), object()))
    monkeypatch.setattr(finder, "_mended", lambda *_: finder.interrupted())
    assert finder.run(MaxDrop(0.5), best_effort=True).chosen.size == 100


class Settling(Mended):
    """The log of the loss falls by `gain` for each unit by which the log of the steps of constant colours does."""

    gain = 0.0

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        found = super().measure(planes, estimate)
        if estimate or not self.grids:
            return found
        drop = (found.drop or 0.0) * (dc_share(self.grids[-1]) / dc_share(self.grids[0])) ** self.gain
        return Measurement(drop, 30.0, drop)


def dc_share(grid: GridScene) -> float:
    """Step of constant colours over that of opacities."""
    return grid.step_sizes.dc / grid.step_sizes.opacity


class Finer(Mending):
    """The first candidate misses by `miss`, all further ones hold. What holds is not landed."""

    miss, _with_finer = 0.0, GridSearch._with_finer

    def _aim(self, multiplier: float, steps: Sequence[Candidate], target: Target) -> float:
        return AT * math.exp((-0.02 if len(steps) else self.miss) / 0.6)

    def _landed_on_quality(self, found: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
        return found


@pytest.mark.parametrize(
    ("miss", "gain", "factors"),
    [(0.06, 0.3, [1, 0.8]), (0.06, 0.2, [1, 0.8, 0.64]), (0.06, 0.1, [1, 0.8, 1]), (0.08, 0.5, [1, 1])],
)
def test_a_descent_that_hardly_misses_gets_finer_constant_colours(
    miss: float, gain: float, factors: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are the descent's, not the grid's that missed. Where they gain less than half of it, another candidate is made."""
    world = Settling(1.0, 1.0)
    world.gain = gain
    monkeypatch.setattr(Finer, "miss", miss)
    Mending.calls = calls = []
    result = search(world, MaxDrop(1.0), kind=Finer, refit=True, steps=100)
    assert result.reached and len(calls) == factors.count(1) and len(result.steps) == len(factors)
    assert [dc_share(grid) / dc_share(world.grids[0]) for grid in world.grids] == pytest.approx(factors)
    assert dc_share(result.product) == pytest.approx(factors[-1] * dc_share(world.grids[0]))
    if factors[-1] < 1:
        assert off_the_original(result.product) < 0.9 * off_the_original(world.grids[0])


def test_an_interruption_while_colours_get_finer_keeps_the_best_result(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: Any) -> Any:
        raise KeyboardInterrupt

    world = Settling(1.0, 1.0)
    monkeypatch.setattr(Finer, "miss", 0.06)
    monkeypatch.setattr(Finer, "_with_finer_constants", interrupt)
    result = search(world, MaxDrop(1.0), kind=Finer, refit=True, steps=100, best_effort=True)
    assert not result.reached and result.product is world.grids[0]


def off_the_original(grid: GridScene) -> float:
    """How far constant colours are from the nearest ones of the original, in the mean."""
    colours, original = (planes["sh_dc"].T for planes in (values_of(grid), FakeRounds().snapshots[0].planes))
    return float(np.linalg.norm(colours[:, None] - original, axis=2).min(axis=1).mean())


@pytest.mark.parametrize(
    ("target", "most_left"), [(MaxDrop(1.0), MOST_LEFT), (MaxDrop(1.0), 9.0), (MaxSize(2000), 9.0)]
)
def test_descents_between_the_rounds(target: Target, most_left: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """They come before the first candidate, with a share of its steps, and all costs are measured anew behind them."""
    monkeypatch.setattr(descents, "MOST_LEFT", most_left)
    counts, losses = between(Mended(0.5, 1.0), target, 20, monkeypatch)
    if isinstance(target, MaxSize):
        assert counts[0] * 50 / 8 < MOST_FIT * 2000 and 0.75 * LEAST_FIT * 2000 < counts[-1] * 50 / 8 < LEAST_FIT * 2000
        assert 3 < len(counts) < 20
    else:
        # The last two leave too much for another, or the last one so much that it does not count.
        assert all(before >= EFFORT.interleave_at for before, _ in losses)
        enough = [after >= INTERLEAVE_TO for _, after in losses]
        assert losses[-1][1] >= MOST_LEFT if most_left == MOST_LEFT else enough[-2:] == [True, True]
        assert not any(a and b for a, b in zip(enough[:-2], enough[1:-1], strict=True))
        assert all(after < most_left for _, after in losses[:-1])
        assert 1 < len(counts) < 20


def test_no_more_descents_between_the_rounds_than_an_effort_allows(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(between(Mended(0.5, 1.0), MaxDrop(1.0), 1, monkeypatch)[0]) == 1


def test_where_all_that_is_left_stays_only_steps_get_finer() -> None:
    rounds = FakeRounds()
    finder = KnownSearch(rounds, lambda _: 0, lambda *_: None, EFFORT, steps=100)  # type: ignore[arg-type]
    rounds.renew(lambda: (np.arange(500), take_rows(rounds.snapshots[0].planes, np.arange(500))))
    finder._begin = 1
    quality = Measurement(0.3, 30.0, 0.3)

    def step(excess: float, multiplier: float = 1.0, count: int = 490) -> Candidate:
        return Candidate(multiplier, count, 0, 100, quality, excess, 0.0)

    far, near = (finder._aim(0.9, [step(0.1, count=count)], MaxDrop(1.0)) for count in (490, 400))
    assert far == pytest.approx(math.exp(-0.16 / 0.35)) and near == pytest.approx(0.9 * math.exp(-0.05 / 0.7))
    # Between two whole results, their line decides.
    assert finder._aim(0.8, [step(0.1), step(-0.1, 0.7)], MaxDrop(1.0)) == pytest.approx(0.8)
    # Finer steps gain little: others are missing.
    assert finder._used_up([step(0.30), step(0.29, 0.8)]) and not finder._used_up([step(0.30), step(0.25, 0.8)])
    assert not finder._used_up([step(0.1), step(0.09, 0.8)])
    assert not finder._used_up([step(0.30), step(0.29, 0.8, 400)]) and not finder._used_up([step(0.3)])


def between(
    world: Mended, target: Target, most: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[list[int], list[tuple[float, float]]]:
    """Rows of each descent between the rounds, and the losses before and after it."""
    counts: list[int] = []
    losses: list[tuple[float, float]] = []

    def moved(
        planes: dict[str, np.ndarray], degrees: np.ndarray, original: Any, schedule: Schedule, steps: Any, **words: Any
    ) -> Any:
        assert steps is None and words == {"structure": STRUCTURE}  # the mean alone is asked for
        assert schedule.last == INTERLEAVED_LAST and schedule.iterations == 50
        counts.append(len(degrees))
        return {**planes, "opacity_logits": np.full_like(planes["opacity_logits"], MARK)}

    class Watched(Mending):
        def _descend_between(self) -> None:
            before = self._loss()
            super()._descend_between()
            losses.append((before, self._loss()))

        def _loss(self) -> float:
            by_size = target.limit_bytes is not None
            return 0.0 if by_size else math.exp(self._guess(self.rounds.snapshots[-1].planes, target))

    monkeypatch.setattr(grid_results, "distil", moved)
    Mending.calls = calls = []
    effort = replace(EFFORT, interleaved=most)
    result = search(world, target, FakeRounds(), kind=Watched, refit=True, steps=100, effort=effort)
    assert result.reached and sorted(counts, reverse=True) == counts
    counted = [count for count, (_, after) in zip(counts, losses, strict=True) if after < descents.MOST_LEFT]
    assert counted[-1] >= result.chosen.count
    # No pilot, and candidates start from values that have moved.
    descended = len({step.multiplier for step in result.steps})
    assert [(steps, before) for steps, _, before in calls] == [(100, MARK)] * descended
    return counts, losses


@pytest.mark.parametrize(("steps", "after"), [(100, 1), (100, 0), (0, 1)])
def test_an_interrupted_search_with_descents_keeps_the_best(steps: int, after: int) -> None:
    done: list[int] = []
    Mending.calls = []

    class Interrupted(Mending):
        def _whole(self, multiplier: float, target: Target) -> Any:
            if len(done) == after:
                raise KeyboardInterrupt
            done.append(1)
            grid = self._before_refit(multiplier)
            measurement = Measurement(0.5, 42.0, 0.5)
            return Candidate(multiplier, 1, 0, 4000, measurement, target.excess(4000, measurement), 0.0), grid

    if steps and after:
        assert search(powers(), MaxDrop(1.0), kind=Interrupted, steps=steps).chosen.size == 4000
    else:
        with pytest.raises(KeyboardInterrupt):
            search(powers(), MaxDrop(1.0), kind=Interrupted, steps=steps)


def test_an_interrupted_landing_keeps_the_best(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: Any, **__: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(grid_search, "land_on_quality", interrupted)
    monkeypatch.setattr(grid_search, "NEAR_QUALITY", 0.0)
    Mending.calls = []
    found = search(Mended(0.5, 1.0), MaxDrop(1.0), kind=Mending, steps=100)
    assert found.reached and found.chosen in found.steps
    with pytest.raises(KeyboardInterrupt):
        search(Mended(0.5, 1.0), MaxDrop(1.0), kind=Mending, steps=0)
