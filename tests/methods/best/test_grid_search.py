"""The search over one multiplier, on a world whose size and loss are known functions of it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flexgs_edge.errors import TargetError
from flexgs_edge.goals.promise import MeanSsim, Promised, WorstView
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, MinFidelity, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.methods.best import descents, grid_search
from flexgs_edge.methods.best.candidates import Candidate, RateResult
from flexgs_edge.methods.best.choose_steps import GEOMETRY, Slopes, choose_steps
from flexgs_edge.methods.best.costs import RemovalCosts
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
from flexgs_edge.methods.best.effort import (
    EFFORTS,
    LARGEST_STEP,
    LEAST_STEPS,
    Effort,
    distil_steps,
    sampled_poses,
    sampling_steps,
)
from flexgs_edge.methods.best.grid_search import GridSearch
from flexgs_edge.methods.best.kept import Kept, Refitted
from flexgs_edge.methods.best.multiplier import EXTRA_STEPS
from flexgs_edge.methods.best.refit.distil import Schedule
from flexgs_edge.methods.best.rounds import Snapshot, take_rows
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.fields import FIELD
from synthetic import make_camera, random_scene

SLOPES = Slopes(dict.fromkeys(GEOMETRY, 100.0))
UNIT = choose_steps(SLOPES, np.ones(1), np.zeros(1), 0, 1.0).opacity
EFFORT = Effort(keep=0.8, refit_rounds=1, subsets=2, steps=4, close=0.03, few=8, views=8, pixels=24)
AT = 1e-4
BYTES = 4000
"""The multiplier at which the worlds lose 1 dB, and the bytes that they take there (53 bits for each of 600 Gaussians)."""


class FakeRounds:
    """A path whose costs are known: descending removes the cheapest and changes no cost."""

    storage = IN_MEMORY

    def __init__(self, count: int = 600, degree: int = 1, unseen: int = 0, scale: float = 1.0) -> None:
        rng = np.random.default_rng(81)
        planes = random_scene(count, 82, degree).read(slice(0, count), list(FIELD))
        weight2 = np.where(np.arange(count) < unseen, 0.0, 1.0)
        removal = rng.lognormal(math.log(scale * AT * 50), 3, count) * (weight2 > 0)
        sh = rng.lognormal(math.log(scale * AT * 10), 2, (degree, count)) * (weight2 > 0)
        costs = RemovalCosts(removal, weight2, sh, np.zeros((degree, 3, count), np.float32))
        self.original = SimpleNamespace(origin=np.zeros(3), cameras=range(10), bench=SimpleNamespace(renderer=None))
        self.snapshots = [Snapshot(np.arange(count), planes, costs)]
        self.shares: list[float] = []

    def descend(self, share: float) -> Snapshot:
        self.shares.append(share)
        last = self.snapshots[-1]
        keep = np.flatnonzero(last.cheapest(last.count - round(last.count * share)))
        c = last.costs
        costs = RemovalCosts(c.removal[keep], c.weight2[keep], c.sh[:, keep], c.sh_mean[:, :, keep])
        self.snapshots.append(Snapshot(last.rows[keep], take_rows(last.planes, keep), costs))
        return self.snapshots[-1]

    def renew(self, change: Callable[[], tuple[np.ndarray, dict[str, np.ndarray]]]) -> None:
        rows, planes = change()
        c, keep = self.snapshots[0].costs, rows
        costs = RemovalCosts(c.removal[keep], c.weight2[keep], c.sh[:, keep], c.sh_mean[:, :, keep])
        self.snapshots.append(Snapshot(rows, planes, costs))


class World:
    """Size and loss as functions of the multiplier, which is read back from the steps of the grid made last."""

    multiplier: float | None = None

    def __init__(self, loss: Callable[[float], float], size: Callable[[float], float], floor: float = 0.0) -> None:
        self.loss, self.size, self.floor = loss, size, floor
        self.grids: list[GridScene] = []
        self.rounds = FakeRounds()

    def size_of(self, grid: GridScene) -> int:
        self.grids.append(grid)
        assert self.multiplier is not None
        return round(self.size(self.multiplier))

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        if self.multiplier is None:  # the walk down, before anything was coded: pruning alone
            costs = self.rounds.snapshots[-1].costs
            least = costs.removal[costs.weight2 > 0].min(initial=1e9)
            drop = 0.45 * max(self.loss(max(least / 50, 1e-30)), self.floor)
        else:
            drop = max(self.loss(self.multiplier), self.floor)
        return Measurement(drop, 42 - 10 * math.log10(max(drop, 1e-9)), drop)


def powers(loss: float = 0.6, size: float = -0.45) -> World:
    return World(lambda m: (m / AT) ** loss, lambda m: BYTES * (m / AT) ** size)


class KnownSearch(GridSearch):
    """A search in a world: slopes are known, and the world learns the multiplier."""

    world: World

    def _to_grid(self, planes: Any, degrees: Any, steps: StepSizes, storage: Storage = IN_MEMORY) -> Any:
        self.world.multiplier = (steps.opacity / UNIT) ** 2
        return super()._to_grid(planes, degrees, steps, storage)

    def _probe_slopes(self, snapshot: Snapshot) -> Slopes:
        return SLOPES

    def _removal_costs(self, grid: GridScene) -> np.ndarray:
        return np.arange(grid.count, dtype=np.float64)


def search(
    world: World,
    target: Target,
    rounds: FakeRounds | None = None,
    best_effort: bool = False,
    kind: type[KnownSearch] = KnownSearch,
    **words: Any,
) -> RateResult[GridScene]:
    words = {"effort": EFFORT, "refit": False, **words}
    world.multiplier = None
    world.rounds = rounds or FakeRounds()
    found = kind(world.rounds, world.size_of, world.measure, **words)  # type: ignore[arg-type]
    found.world = world
    return found.run(target, best_effort)


def best_of(steps: tuple[Candidate, ...]) -> Candidate:
    """The smallest step that holds."""
    return min((step for step in steps if step.holds), key=lambda step: step.size)


@pytest.mark.parametrize("target", [MaxDrop(1.0), MaxDrop(0.1), MaxDrop(3.0), MinFidelity(42.0), MinFidelity(48.0)])
@pytest.mark.parametrize("loss", [0.5, 0.6, 0.8, 1.2])
def test_smooth_worlds_are_met_closely_with_few_steps(loss: float, target: Target) -> None:
    found = search(powers(loss), target)
    assert found.reached and found.chosen.holds and found.chosen == best_of(found.steps)
    assert -0.15 < found.chosen.excess <= 0, [step.excess for step in found.steps]
    assert found.chosen.excess > -EFFORT.close and len(found.steps) <= 3


def test_a_world_with_a_shallow_slope_is_met_as_well() -> None:
    assert search(powers(0.35), MaxDrop(0.1), best_effort=True).reached


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e6])
def test_the_unit_of_errors_does_not_matter(scale: float) -> None:
    world = World(lambda m: (m / (scale * AT)) ** 0.6, lambda m: BYTES * (m / (scale * AT)) ** -0.45)
    found = search(world, MaxDrop(1.0), FakeRounds(scale=scale))
    assert found.reached and found.chosen.excess > -EFFORT.close
    assert found.chosen.multiplier == pytest.approx(scale * AT, rel=0.1)


@pytest.mark.parametrize("wiggle", [0.1, 0.3])
@pytest.mark.parametrize("pace", [3.0, 11.0])
def test_a_rough_world_gives_the_best_point_that_was_seen(pace: float, wiggle: float) -> None:
    """The loss falls again in places, as it does where another snapshot is taken."""
    world = World(
        lambda m: (m / AT) ** 0.6 * (1 + wiggle * math.sin(pace * math.log(m))), lambda m: BYTES * (m / AT) ** -0.45
    )
    found = search(world, MaxDrop(1.0))
    assert found.reached and found.chosen == best_of(found.steps)
    assert found.chosen.size < 1.3 * BYTES
    assert len(found.steps) <= EFFORT.steps + EXTRA_STEPS


def test_steps_are_not_asked_twice() -> None:
    world = World(lambda m: 0.5 if m < AT else 2.0, lambda m: BYTES * (m / AT) ** -0.45)  # a cliff: nothing is close
    found = search(world, MaxDrop(1.0))
    asked = EFFORT.steps + EXTRA_STEPS
    multipliers, landed = ([step.multiplier for step in part] for part in (found.steps[:asked], found.steps[asked:]))
    assert found.reached and len(set(multipliers)) == len(multipliers) == asked
    assert set(landed) == {found.chosen.multiplier}
    assert found.chosen.multiplier == pytest.approx(AT, rel=0.5)


def test_out_of_reach_names_the_closest_point() -> None:
    world = powers()
    world.floor = 2.0
    with pytest.raises(TargetError, match=r"drop <= 1 dB is out of reach.*drop 2\.000 dB at .*--best-effort"):
        search(world, MaxDrop(1.0))
    found = search(powers_with_floor(2.0), MaxDrop(1.0), best_effort=True)
    assert not found.reached and not found.chosen.holds and len(found.steps) == EFFORT.steps + EXTRA_STEPS
    assert found.chosen.excess == min(step.excess for step in found.steps)
    assert found.product.count > 0


def powers_with_floor(floor: float) -> World:
    world = powers()
    world.floor = floor
    return world


@pytest.mark.parametrize("limit", [1000, 2000, 4000, 8000])
def test_size_targets_give_the_best_quality_that_fits(limit: int) -> None:
    found = search(powers(), MaxSize(limit, "drop"))
    assert found.reached and found.chosen.size <= limit
    assert found.chosen.size > 0.85 * limit, [step.size for step in found.steps]
    fitting = [step for step in found.steps if step.size <= limit]
    assert found.chosen.measurement.drop == min(step.measurement.drop for step in fitting)  # type: ignore[type-var]


def test_a_size_that_nothing_fits_into() -> None:
    world = World(lambda m: (m / AT) ** 0.6, lambda m: 2000 + 10 * (m / AT) ** -0.45)
    with pytest.raises(TargetError, match=r"size <= 900 B is out of reach"):
        search(world, MaxSize(900, "drop"))
    assert search(world, MaxSize(900, "drop"), best_effort=True).chosen.size == pytest.approx(2000, rel=0.05)


def test_the_file_is_the_chosen_step_s() -> None:
    world = powers()
    seen: list[Candidate] = []
    found = search(world, MaxDrop(1.0), on_step=seen.append)
    assert tuple(seen) == found.steps
    assert any(found.product is grid for grid in world.grids)
    assert (found.product.count, found.product.sh_count) == (found.chosen.count, found.chosen.sh_count)
    assert found.product.step_sizes.opacity == pytest.approx(UNIT * math.sqrt(found.chosen.multiplier), rel=1e-5)


def test_the_same_search_every_time() -> None:
    one, two = (search(powers(), MaxDrop(1.0)) for _ in range(2))
    assert [replace(s, seconds=0.0) for s in one.steps] == [replace(s, seconds=0.0) for s in two.steps]
    for name in ("position", "scale", "rotation", "opacity", "dc", "sh_degrees"):
        np.testing.assert_array_equal(getattr(one.product, name), getattr(two.product, name))


def test_the_path_is_walked_down_by_the_effort_s_share() -> None:
    rounds = FakeRounds()
    found = search(powers(), MaxDrop(1.0), rounds, effort=replace(EFFORT, keep=0.7))
    assert set(rounds.shares) == {0.7} and found.chosen.count <= rounds.snapshots[0].count
    counts = [snapshot.count for snapshot in rounds.snapshots]
    assert counts == sorted(counts, reverse=True)


def test_larger_multipliers_keep_fewer() -> None:
    found = search(powers(), MaxDrop(1.0))
    steps = sorted(found.steps, key=lambda step: step.multiplier)
    assert all(a.count >= b.count for a, b in zip(steps, steps[1:]))


def test_unseen_gaussians_stay() -> None:
    rounds = FakeRounds(unseen=60)
    found = search(powers(), MaxDrop(1.0), rounds)
    positions = np.rint(rounds.snapshots[0].planes["means"][:, :60] / found.product.step_sizes.position).astype(int)
    kept = {tuple(p) for p in found.product.position.T.tolist()}
    assert found.reached and all(tuple(p) in kept for p in positions.T.tolist())


def test_unseen_gaussians_that_would_coarsen_the_grid_go() -> None:
    calm, astray = FakeRounds(unseen=60), FakeRounds(unseen=60)
    astray.snapshots[0].planes["means"][:, 7] = 1e7
    steps, counts = zip(
        *(
            (found.product.step_sizes, found.product.count)
            for found in (search(powers(), MaxDrop(1.0), rounds) for rounds in (calm, astray))
        )
    )
    assert steps[0] == steps[1] and counts[1] == counts[0] - 1


@pytest.mark.parametrize("count", [1, 2, 15, 17])
@pytest.mark.parametrize("target", [MaxDrop(1.0), MaxSize(3000, "drop")])
def test_few_gaussians(count: int, target: Target) -> None:
    found = search(powers(), target, FakeRounds(count))
    assert found.reached and found.product.count <= count


@pytest.mark.parametrize("target", [MaxDrop(1.0), MaxSize(3000, "drop")])
def test_no_more_gaussians_than_allowed(target: Target) -> None:
    rounds = FakeRounds(600)
    world = powers()
    world.rounds = rounds
    finder = KnownSearch(rounds, world.size_of, world.measure, EFFORT, refit=False)
    finder.world, finder.most = world, 100
    found = finder.run(target)
    assert found.reached and all(step.count <= 100 for step in found.steps)
    assert search(powers(), target, FakeRounds(600)).chosen.count > 100


def test_a_limit_of_gaussians_ends_what_cannot_get_better() -> None:
    """Where all that is allowed stays and finer grids gain nothing, the second candidate is the last."""
    rounds, world = FakeRounds(600), World(lambda m: 3.0, lambda m: BYTES * (m / AT) ** -0.45)
    world.rounds = rounds
    finder = KnownSearch(rounds, world.size_of, world.measure, EFFORT, refit=False)
    finder.world, finder.most = world, 20
    with pytest.raises(TargetError, match=r"as many Gaussians as --max-gaussians 20 allows"):
        finder.run(MaxDrop(1.0))
    found = finder.run(MaxDrop(1.0), best_effort=True)
    assert len(found.steps) == 2 and found.chosen.count == 20


def test_nothing_that_any_pose_sees() -> None:
    found = search(powers(), MaxDrop(1.0), FakeRounds(40, unseen=40), best_effort=True)
    assert found.product.count == 40 and found.product.sh_count == 0


def test_efforts_grow() -> None:
    fast, balanced, most = EFFORTS.values()
    for name in ("keep", "refit_rounds", "steps", "views", "passes"):
        assert getattr(fast, name) <= getattr(balanced, name) <= getattr(most, name)
        assert getattr(fast, name) < getattr(most, name)
    assert fast.close > balanced.close > most.close
    assert fast.passes == 0 < balanced.passes < most.passes


def test_who_descends() -> None:
    passes, least = EFFORTS["balanced"].passes, EFFORTS["balanced"].descends
    assert distil_steps(CompressOptions(), 100, 1000 * least) == round(100 * passes)
    assert distil_steps(CompressOptions(), 2, least) == LEAST_STEPS
    assert distil_steps(CompressOptions(), 100, least - 1) == 0 < distil_steps(CompressOptions(), 100, least)
    assert distil_steps(CompressOptions(effort="max"), 100, least - 1) > 0
    assert distil_steps(CompressOptions(distil=7), 100, least - 1) == 7
    for words, foreign in (({"distil": 0}, False), ({"refit": False}, False), ({"effort": "fast"}, False), ({}, True)):
        assert distil_steps(CompressOptions(**words), 100, least, foreign) == 0, (words, foreign)


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
    """Descents mark opacities; `calls` has the steps, rate and first opacity of each."""

    calls: list[tuple[int, float, float]]

    def _distil(self, kept: Kept, schedule: Schedule, steps: StepSizes) -> Any:
        logits = kept.planes["opacity_logits"]
        self.calls.append((schedule.iterations, schedule.rate, float(logits.max())))
        return {**kept.planes, "opacity_logits": np.full_like(logits, MARK)}

    def _refit_colours(self, planes: Any, *_: Any, **__: Any) -> Any:
        return planes


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


class Leaning(Mended):
    """The mean is better than guessed, and one view loses what no removal changes. Each row that goes costs as much."""

    at, whole = 0.0, 0

    def size_of(self, grid: GridScene) -> int:
        assert self.multiplier is not None
        if self.multiplier != self.at:
            self.at, self.whole = self.multiplier, grid.count
        return 10 * grid.count

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        drop = super().measure(planes, estimate).drop or 0.0
        if estimate:
            return Measurement(drop, 30.0, drop)
        drop = 0.6 * drop + 0.002 * (self.whole - planes["means"].shape[1])
        return Measurement(drop, 30.0, drop, worst=Measurement(0.72, 30.0, 0.72), usual=drop)


def test_a_result_whose_worst_view_alone_misses_loses_gaussians() -> None:
    """.72 dB is more than 1.5 times .3 plus .2, but less than 1.5 times what the mean may lose plus .2."""
    world = Leaning(1.0, 1.0)
    result = search(world, Promised(MaxDrop(0.5), (WorstView("drop"),)), kind=Mending, refit=False, steps=0)
    assert not result.steps[0].holds and result.reached and len(result.steps) <= 4
    assert result.chosen.multiplier == result.steps[0].multiplier and result.chosen.count < result.steps[0].count


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

    def moved(planes: dict[str, np.ndarray], degrees: np.ndarray, original: Any, schedule: Schedule) -> Any:
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

    monkeypatch.setattr(grid_search, "distil", moved)
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


def test_a_refit_goes_on_from_the_last_one_where_the_degree_is_the_same() -> None:
    rng = np.random.default_rng(5)
    refitted = {"sh_dc": rng.normal(size=(3, 3)).astype(np.float32), "sh_rest": np.ones((9, 3), np.float32)}
    last = Refitted.of(np.array([2, 5, 7]), np.array([0, 1, 1]), np.array([2, 0, 1]), refitted)
    planes = {"sh_dc": np.zeros((3, 4), np.float32), "sh_rest": np.zeros((24, 4), np.float32), "means": np.ones((3, 4))}
    found = last.apply(np.array([1, 2, 5, 7]), np.array([1, 1, 1, 1]), planes)
    np.testing.assert_array_equal(
        found["sh_dc"], np.stack([0 * refitted["sh_dc"][:, 0]] * 2 + [*refitted["sh_dc"].T[[2, 0]]], 1)
    )
    # Three coefficients of eight a channel were there before; row 2 had another degree, row 1 was not kept.
    expected = np.zeros((3, 8, 4))
    expected[:, :3, 2:] = 1
    np.testing.assert_array_equal(found["sh_rest"].reshape(3, 8, 4), expected)
    assert not planes["sh_dc"].any() and found["means"] is planes["means"]


@pytest.mark.parametrize(("count", "step"), [(10, LARGEST_STEP), (100, 3), (240, 2), (260, 1), (10**6, 1)])
def test_poses_have_no_more_pixels_than_the_rows_need(count: int, step: int) -> None:
    cameras = [make_camera(64, 48) for _ in range(8)]
    assert sampling_steps(cameras, 24 * count) == [step] * 8
    assert sampling_steps(cameras, 24 * count, 0.5) == sampling_steps(cameras, 48 * count)
    assert sampling_steps(cameras, 24 * count, 0.0) == [1] * 8
    sampled = sampled_poses(cameras, [step] * 8)
    assert {camera.width for camera in sampled} == {-(-64 // step)} | ({64 // step} if 64 % step else set())
    if 1 < step < LARGEST_STEP:
        pixels = sum(camera.width * camera.height for camera in sampled)
        assert pixels >= 24 * count
    # Not the same lattice in every view.
    assert len({(camera.cx, camera.cy) for camera in sampled}) == min(step**2, 8)


def test_poses_get_pixels_by_their_weights() -> None:
    """About in proportion, between all of them and one of the largest step; never fewer in all than the rows need."""
    cameras = [make_camera(64, 48) for _ in range(4)]
    weights = np.array([1.0, 0.25, 1 / 9, 1e-6])
    assert sampling_steps(cameras, 1, weights=weights) == [4, 4, 4, 4]
    assert sampling_steps(cameras, 4300, weights=weights) == [1, 2, 3, 4]
    assert sampling_steps(cameras, 4 * 64 * 48, weights=weights) == [1, 1, 1, 1]
    for pixels in range(800, 12_000, 700):
        steps = sampling_steps(cameras, pixels, weights=weights)
        assert steps == sorted(steps) and sum((64 // step) * (48 // step) for step in steps) >= pixels


def test_large_scenes_are_scored_from_more_poses() -> None:
    effort = replace(EFFORT, few=3, views=6, pixels=10)
    pixels = [100] * 9
    assert [effort.poses_of(pixels, count) for count in (1, 30, 31, 40, 41, 60, 1000)] == [3, 3, 4, 4, 5, 6, 6]
    assert effort.poses_of(pixels[:2], 1) == effort.poses_of(pixels[:2], 1000) == 2
