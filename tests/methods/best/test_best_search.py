"""The search over one multiplier, in worlds whose size and loss are known functions of it."""

from __future__ import annotations

import math
from typing import Any

import pytest

from flexgs_edge.errors import TargetError
from flexgs_edge.goals.promise import Promised, WorstView
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, MinFidelity, Target
from flexgs_edge.methods.best.search import MOST_TRIED, Candidate, next_place, search, search_size
from known_maker import AT, BYTES, World, powers


@pytest.mark.parametrize("target", [MaxDrop(1.0), MaxDrop(0.1), MaxDrop(3.0)])
@pytest.mark.parametrize("loss", [0.5, 0.6, 0.8, 1.2])
def test_smooth_worlds_are_met_closely_with_few_candidates(loss: float, target: Target) -> None:
    world = powers(loss)
    found = search(world, target)
    assert found.reached and found.chosen == min((s for s in found.steps if s.holds), key=lambda step: step.size)
    assert found.chosen.excess > -0.09 and len(world.made) <= 4 and len(found.steps) <= MOST_TRIED


@pytest.mark.parametrize("guess", [0.7, 1.0, 1.4])
def test_probes_place_the_first_candidate(guess: float) -> None:
    world = powers(guess=guess, start=30 * AT)
    first = search(world, MaxDrop(1.0)).steps[0]
    assert 1 < world.probed <= 4 and first.excess == pytest.approx(-math.log(guess), abs=0.05)


@pytest.mark.parametrize("scale", [1e-6, 1e6])
def test_the_unit_of_errors_does_not_matter(scale: float) -> None:
    one, other = search(powers(), MaxDrop(0.3)), search(powers(scale=scale, start=scale * AT), MaxDrop(0.3))
    assert [step.size for step in one.steps] == [step.size for step in other.steps]


@pytest.mark.parametrize("wiggle", [0.1, 0.3])
@pytest.mark.parametrize("pace", [3.0, 11.0])
def test_a_rough_world_gives_the_best_point_that_was_seen(pace: float, wiggle: float) -> None:
    """The loss falls again in places, as it does where another snapshot is taken."""
    world = World(
        lambda m: (m / AT) ** 0.6 * (1 + wiggle * math.sin(pace * math.log(m))), lambda m: BYTES * (m / AT) ** -0.45
    )
    found = search(world, MaxDrop(1.0))
    assert found.reached and found.chosen.size < 1.3 * BYTES and len(found.steps) <= MOST_TRIED


def test_no_two_candidates_are_alike() -> None:
    world = World(lambda m: 0.5 if m < AT else 2.0, lambda m: BYTES * (m / AT) ** -0.45)  # a cliff: nothing is close
    found = search(world, MaxDrop(1.0))
    assert found.reached and len(world.made) == len(set(world.made)) == 4
    assert len({step.size for step in found.steps}) == len(found.steps)


def test_out_of_reach_names_the_closest_point() -> None:
    with pytest.raises(TargetError, match=r"drop <= 1 dB is out of reach.*drop 2\.000 dB at .*--best-effort"):
        search(floored(2.0), MaxDrop(1.0))
    found = search(floored(2.0), MaxDrop(1.0), best_effort=True)
    assert not found.reached and len(found.steps) == MOST_TRIED
    assert found.chosen.excess == min(step.excess for step in found.steps)


def floored(floor: float) -> World:
    return World(lambda m: max((m / AT) ** 0.6, floor), lambda m: BYTES * (m / AT) ** -0.45)


def test_the_bound_in_the_way_is_named() -> None:
    world = powers()
    world.worst, world.seen = 90.0, [[], []]
    target = Promised(MaxDrop(1.0), (WorstView("drop", 0.02),))
    with pytest.raises(TargetError, match=r"Of the promise, the worst view stands in the way"):
        search(world, target)


def test_candidates_are_six_while_none_holds() -> None:
    world = World(lambda m: 50.0 * (m / AT) ** 0.12, lambda m: BYTES * (m / AT) ** -0.45)
    assert len(search(world, MaxDrop(0.001), best_effort=True).steps) == MOST_TRIED


@pytest.mark.parametrize("limit", [1000, 2000, 4000, 8000])
def test_size_targets_give_the_best_quality_that_fits(limit: int) -> None:
    world = powers()
    found = search(world, MaxSize(limit, "drop"))
    assert found.reached and 0.9 * limit < found.chosen.size <= limit and not world.trimmed
    fitting = [step.measurement.drop or 0.0 for step in found.steps if step.holds]
    assert found.chosen.measurement.drop == min(fitting)


def test_a_size_that_nothing_fits_into() -> None:
    world = World(lambda m: (m / AT) ** 0.6, lambda m: 2000 + 10 * (m / AT) ** -0.45)
    with pytest.raises(TargetError, match=r"size <= 900 B is out of reach"):
        search(world, MaxSize(900, "drop"))


def test_products_that_are_not_the_best_are_freed() -> None:
    world = powers(1.2)
    found = search(world, MaxDrop(0.1))
    assert sorted([*world.freed, found.product]) == list(range(1, len(world.made) + 1))
    assert world.made[found.product - 1] == found.chosen.multiplier


def test_candidates_are_told() -> None:
    seen: list[Candidate] = []
    assert search(powers(1.2), MaxDrop(0.1), on_step=seen.append).steps == tuple(seen)


@pytest.mark.parametrize(("worst", "seen"), [(1.2, []), (9.0, [[1]])])
def test_poses_beside_a_view_that_alone_loses_too_much(worst: float, seen: list[list[int]]) -> None:
    """They are scored too, and the search goes on with the same multiplier, whose costs are others now."""
    world = powers()
    world.worst = worst
    found = search(world, Promised(MaxDrop(1.0), (WorstView("drop", 1.7),)))
    assert found.reached and world.seen == seen
    if seen:
        assert world.made[0] == world.made[1]


def test_an_interrupted_search_takes_the_best_so_far() -> None:
    class Interrupted(World):
        def make(self, multiplier: float, target: Target) -> Any:
            if self.made:
                raise KeyboardInterrupt
            return super().make(multiplier, target)

    world = Interrupted(lambda m: 0.5, lambda m: BYTES)
    first = search(world, MaxDrop(1.0))
    assert first.chosen.size == BYTES and first.interrupted
    world.made = [1.0]
    with pytest.raises(KeyboardInterrupt):
        search(world, MaxDrop(1.0))


def size_world(loss: float, at: float = AT) -> World:
    """Loses `loss` dB at the size that is asked for, and less in a larger file."""
    return World(lambda m: loss * (m / at) ** 0.7, lambda m: BYTES * (m / at) ** -0.45, start=1.5 * at)


@pytest.mark.parametrize("plain_loss", [0.5, 2.0])
def test_of_a_size_the_better_maker_goes_on(plain_loss: float) -> None:
    """The other one gets a single candidate with a descent, or a few without."""
    made: list[World] = []
    steps: list[Candidate] = []

    def begin(loss: float) -> World:
        made.append(size_world(loss))
        return made[-1]

    target = MaxSize(BYTES, "drop")
    found = search_size(lambda: begin(plain_loss), lambda: begin(1.0), target, on_step=steps.append)
    assert found.reached and set(found.steps) == set(steps) and len(steps) <= MOST_TRIED
    assert found.chosen.measurement.drop == pytest.approx(min(plain_loss, 1.0), rel=0.05)
    assert len(made[1].made) == (1 if plain_loss < 1.0 else len(found.steps) - len(made[0].made))
    assert len(made) == (3 if plain_loss < 1.0 else 2)


def test_ctrl_c_ends_both_searches_of_a_size() -> None:
    class Interrupted(World):
        def make(self, multiplier: float, target: Target) -> Any:
            raise KeyboardInterrupt

    target, whole = MaxSize(BYTES, "drop"), size_world(1.0)
    found = search_size(lambda: whole, lambda: Interrupted(whole.loss, whole.size), target)
    assert found.interrupted and found.reached and len(whole.made) == len(found.steps)
    with pytest.raises(KeyboardInterrupt):
        search_size(lambda: Interrupted(whole.loss, whole.size), lambda: pytest.fail("no more"), target)


def test_a_miss_is_followed_by_a_smaller_multiplier_with_some_room() -> None:
    def step(excess: float, multiplier: float) -> Candidate:
        quality = quality_of(excess)
        return Candidate(multiplier, 9, 0, 100, quality, excess, 0.0)

    place = next_place([step(0.1, 1.0)], MaxDrop(1.0))
    assert place is not None and -0.4 < place < -0.1 / 0.7
    place = next_place([step(0.1, 1.0), step(-0.3, 0.5)], MaxDrop(1.0))
    assert place is not None and math.log(0.5) < place < 0.0
    assert next_place([step(-7.0, 1e-30)], MinFidelity(40.0)) is not None


def quality_of(excess: float) -> Any:
    return Measurement(math.exp(excess), 40.0, math.exp(excess))
