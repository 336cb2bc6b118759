"""The search over one multiplier, on a world whose size and loss are known functions of it."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from flexgs_edge.errors import TargetError
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, MinFidelity, Target
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.methods.best.candidates import Candidate, RateResult
from flexgs_edge.methods.best.kept import Refitted
from flexgs_edge.methods.best.multiplier import EXTRA_STEPS
from known_search import AT, BYTES, EFFORT, UNIT, FakeRounds, KnownSearch, World, best_of, powers, search


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
    found = search(world, MaxDrop(1.0), effort=replace(EFFORT, close=0.0))
    asked = EFFORT.steps + EXTRA_STEPS
    multipliers, landed = ([step.multiplier for step in part] for part in (found.steps[:asked], found.steps[asked:]))
    assert found.reached and len(set(multipliers)) == len(multipliers) == asked
    assert set(landed) == {found.chosen.multiplier}
    assert found.chosen.multiplier == pytest.approx(AT, rel=0.5)


@pytest.mark.parametrize(
    ("count", "size", "asked"),
    [(100, 97, 2), (100, 90, 3), (98, 97, 3)],
    ids=["hemmed in", "sizes apart", "other rows"],
)
def test_only_grids_differ_and_sizes_are_close(count: int, size: int, asked: int) -> None:
    """A miss, then one that holds by far: whether a third candidate is made."""
    world, script = powers(), [(0.02, size, count), (-0.3, 100, 100), (-0.01, 95, 100)]

    class Scripted(KnownSearch):
        def _whole(self, multiplier: float, target: Target) -> tuple[Candidate, GridScene]:
            excess, bytes_, rows = script.pop(0)
            _, grid = super()._whole(multiplier, target)
            return Candidate(multiplier, rows, 0, bytes_, Measurement(1.0, 30.0, 1.0), excess, 0.0), grid

        def _landed_on_quality(self, found: RateResult[GridScene], target: Target) -> RateResult[GridScene]:
            return found

    found = search(world, MaxDrop(1.0), kind=Scripted, effort=replace(EFFORT, steps=2, close=0.09))
    assert len(found.steps) == asked and found.reached


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


def test_of_two_searches_the_better_answer_is_taken() -> None:
    target, quality = MaxDrop(1.0), Measurement(0.9, 40.0, 0.9)
    small, large = (Candidate(AT, 9, 0, size, quality, -0.1, 0.0) for size in (500, 600))
    one, other = (RateResult(step.size, step, True, (step,)) for step in (small, large))
    for first, second in ((one, other), (other, one)):
        both = KnownSearch._also(first, second, target)
        assert (both.product, both.chosen) == (500, small) and both.steps == (*first.steps, *second.steps)


def test_nothing_that_any_pose_sees() -> None:
    found = search(powers(), MaxDrop(1.0), FakeRounds(40, unseen=40), best_effort=True)
    assert found.product.count == 40 and found.product.sh_count == 0


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
