"""What a multiplier keeps, and the candidates that are made of it."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest

from flexgs_edge.goals.promise import MeanSsim, Promised
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.methods.best.effort import Effort
from flexgs_edge.methods.best.grid_maker import fits, rate_from
from flexgs_edge.methods.best.refit.finetune import Schedule
from flexgs_edge.methods.best.search import search
from known_rounds import AT, EFFORT, UNIT, FakeRounds, KnownMaker

MARK = 9.0
"""Opacity logit of what a descent has moved."""


class Mended(KnownMaker):
    """The drop grows with what is gone of 600 Gaussians; of what descents have moved, `part` is left of it."""

    part, ssim = 0.5, 0.001

    def __init__(self, rounds: FakeRounds, effort: Effort = EFFORT, **words: Any) -> None:
        super().__init__(rounds, lambda grid: 10 * grid.count, self._quality, effort, **words)  # type: ignore[arg-type]
        self.calls: list[tuple[int, bool, int]] = []

    def _quality(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        logits = planes["opacity_logits"]
        gone = 1 - logits.shape[1] / 600
        drop = 3 * gone * (self.part if (logits > MARK - 1).all() else 1.0)
        return Measurement(drop, 40.0 - drop, drop, ssim_drop=None if estimate else self.ssim * drop)

    def _finetune(self, kept: Any, schedule: Schedule, step_sizes: Any = None) -> Any:
        logits = kept.planes["opacity_logits"]
        self.calls.append((schedule.iterations, step_sizes is not None, logits.shape[1]))
        return {**kept.planes, "opacity_logits": np.full_like(logits, MARK)}


def test_a_quality_is_met_and_trimmed() -> None:
    made = Mended(FakeRounds(), refit=False)
    found = search(made, MaxDrop(1.0))
    assert found.reached and found.chosen.excess > -0.05 and found.chosen.count == found.product.count
    assert found.product.step_sizes.opacity == pytest.approx(UNIT * math.sqrt(found.chosen.multiplier), rel=1e-5)


@pytest.mark.parametrize("limit", [1000, 3000])
def test_a_size_is_met(limit: int) -> None:
    found = search(Mended(FakeRounds(), refit=False), MaxSize(limit, "drop"))
    assert found.reached and 0.95 * limit < found.chosen.size <= limit


def test_no_dear_gaussian_goes_for_a_few_bytes() -> None:
    made = Mended(FakeRounds(), refit=False)
    multiplier = made.start(MaxSize(3000, "drop"))
    grid = made.make(multiplier, MaxSize(3000, "drop"))[1]
    size, dearest = made.size_of(grid), float(made._removal_costs(grid)[-1])
    bits = 8 * size / grid.count
    landed, less = made._landed(grid, size, size - 20, dearest / bits)
    assert landed.count < grid.count and less <= size - 20
    # The two cheapest rows cost nothing, and one more would be needed.
    assert made._landed(grid, size, size - 25, 1e-9 / bits) == (grid, size)


def test_the_same_search_every_time() -> None:
    one, two = (search(Mended(FakeRounds(), refit=False), MaxDrop(1.0)) for _ in range(2))
    assert [replace(s, seconds=0.0) for s in one.steps] == [replace(s, seconds=0.0) for s in two.steps]
    for name in ("position", "scale", "rotation", "opacity", "dc", "sh_degrees"):
        np.testing.assert_array_equal(getattr(one.product, name), getattr(two.product, name))


def test_larger_multipliers_keep_fewer() -> None:
    rounds = FakeRounds()
    selection = Mended(rounds, effort=replace(EFFORT, keep=0.7)).selection
    counts = [len(selection.kept(AT * times).rows) for times in (0.01, 0.1, 1.0, 10.0)]
    assert counts == sorted(counts, reverse=True) and counts[0] > counts[-1] and set(rounds.shares) <= {0.7}


def grid_at(multiplier: float, rounds: FakeRounds) -> GridScene:
    return Mended(rounds, refit=False).make(multiplier, MaxDrop(1.0))[1]


def test_unseen_gaussians_stay() -> None:
    rounds = FakeRounds(unseen=60)
    grid = grid_at(AT, rounds)
    positions = np.rint(rounds.snapshots[0].planes["means"][:, :60] / grid.step_sizes.position).astype(int)
    kept = {tuple(p) for p in grid.position.T.tolist()}
    assert all(tuple(p) in kept for p in positions.T.tolist())
    alone = grid_at(AT, FakeRounds(40, unseen=40))
    assert alone.count == 40 and alone.sh_count == 0


def test_unseen_gaussians_that_would_coarsen_the_grid_go() -> None:
    calm, astray = FakeRounds(unseen=60), FakeRounds(unseen=60)
    astray.snapshots[0].planes["means"][:, 7] = 1e7
    one, other = grid_at(AT, calm), grid_at(AT, astray)
    assert one.step_sizes == other.step_sizes and other.count == one.count - 1


@pytest.mark.parametrize("count", [1, 2, 15, 17])
def test_few_gaussians(count: int) -> None:
    assert 1 <= grid_at(1e9 * AT, FakeRounds(count)).count <= count


@pytest.mark.parametrize("target", [MaxDrop(2.8), MaxSize(3000, "drop")])
def test_no_more_gaussians_than_allowed(target: Target) -> None:
    made = Mended(FakeRounds(), refit=False)
    made.selection.most = 100
    found = search(made, target)
    assert found.reached and all(step.count <= 100 for step in found.steps)


def test_the_second_miss_with_all_that_a_descent_left_goes_back_to_the_descent_before() -> None:
    rounds = FakeRounds()
    selection = Mended(rounds, effort=replace(EFFORT, interleaved=1), steps=100).selection
    for size in (400, 200):
        some = np.sort(np.argsort(-rounds.snapshots[0].costs.removal, kind="stable")[:size])
        planes = {name: values[:, some] for name, values in rounds.snapshots[0].planes.items()}
        rounds.renew(partial(lambda rows, values: (rows, values), some, planes))
    few, all_left = 2.0**24 * AT, 2.0**-36 * AT
    for begin, count in ((2, 200), (1, 400)):
        selection.begin = begin
        kept = selection.kept(few)
        assert len(kept.rows) < 0.97 * count
        selection.missed(kept)
        assert selection.begin == begin
        kept = selection.kept(all_left)
        assert len(kept.rows) == count and selection.begin == begin
        selection.missed(kept)
        assert selection.begin == begin  # a finer grid may do
        selection.missed(kept)
        assert selection.begin == begin - 1


@pytest.mark.parametrize("most", [1, 4])
def test_descents_come_between_the_rounds_and_for_each_candidate(most: int) -> None:
    made = Mended(FakeRounds(), effort=replace(EFFORT, interleaved=most), steps=100)
    search(made, MaxDrop(1.0), best_effort=True)  # in this world losses rise far more slowly than in others
    between = [call for call in made.calls if not call[1]]
    assert 1 <= len(between) <= most and {steps for steps, *_ in between} == {50}
    counts = [count for *_, count in between]
    assert counts == sorted(counts, reverse=True)
    assert {steps for steps, on_grid, _ in made.calls if on_grid} == {100}


def test_where_descents_mend_nothing_colours_are_refitted() -> None:
    made = Mended(FakeRounds(), steps=100)
    made.part = 8.0
    found = search(made, MaxDrop(0.3), best_effort=True)
    assert found.reached and made.steps == 0 and len(made.calls) == 1


@pytest.mark.parametrize("target", [MaxDrop(0.3), MaxSize(4000)])
def test_a_descent_that_makes_the_deciding_views_worse_is_undone(target: Target) -> None:
    rounds = FakeRounds()
    made = Mended(rounds, effort=replace(EFFORT, interleaved=2), steps=100)
    made.part = 8.0
    found = search(made, target, best_effort=True)
    assert found.reached and made.steps == 0 and len(made.calls) == 1
    assert all((snapshot.planes["opacity_logits"] < MARK).all() for snapshot in rounds.snapshots)


def test_a_second_descent_that_is_undone_leaves_the_first() -> None:
    rounds = FakeRounds()
    made = Mended(rounds, effort=replace(EFFORT, interleaved=2), steps=100)
    made.part = 0.2
    found = iter([30.0, 31.0, 30.0, 29.0])  # before and after each
    made._fidelity = lambda planes: next(found)  # type: ignore[method-assign]
    made.start(MaxDrop(1.0))
    marked = [bool((snapshot.planes["opacity_logits"] == MARK).all()) for snapshot in rounds.snapshots]
    assert made.steps == 100 and len(made.calls) == 2 and made.selection.begin == marked.index(True)


def test_a_descent_that_leaves_more_than_allowed_is_undone() -> None:
    rounds = FakeRounds()
    made = Mended(rounds, effort=replace(EFFORT, interleaved=2), steps=100)
    made.part = 0.9
    made.start(MaxDrop(1.0))
    assert len(made.calls) == 1 and made.selection.begin == 0 and made.steps == 100
    assert made._after(0.0) == pytest.approx(np.log(0.9))  # what it mended is expected of others


@pytest.mark.parametrize("ssim", [0.001, 0.03])
def test_the_first_candidate_aims_at_ssim_where_it_is_nearer(ssim: float) -> None:
    made = Mended(FakeRounds(), refit=False)
    made.ssim = ssim
    first = search(made, Promised(MaxDrop(1.0), (MeanSsim(0.015),))).steps[0]
    assert abs(first.excess) < 0.2 and (first.measurement.drop or 0.0) == pytest.approx(min(1.0, 0.015 / ssim), rel=0.2)


def test_descents_with_less_to_mend_go_at_smaller_rates() -> None:
    assert rate_from(30.0) == rate_from(41.0) == 1.0
    assert rate_from(47.0) == pytest.approx(0.5, abs=0.002)  # half the error of 41 dB
    assert rate_from(53.0) == pytest.approx(0.25, abs=0.002) and rate_from(90.0) == 0.25


def test_the_last_descent_before_a_size_has_about_the_rows_that_fit() -> None:
    assert fits(2) == [1.6, 0.8] and fits(1) == [1.6] and not fits(0)
    assert sorted(fits(5), reverse=True) == fits(5)
