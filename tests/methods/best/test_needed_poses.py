"""Poses where the scored ones see too little, and searches that ask for them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.commands.compress import compress
from flexgs_edge.goals.promise import Promised, WorstView, broken_views
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement, Target
from flexgs_edge.memory.process import current_rss
from flexgs_edge.methods.best.multiplier import BROKEN, PosesLacking
from flexgs_edge.methods.best.needed_poses import BESIDE, MOST_TIMES, needed_poses, poses_beside
from flexgs_edge.methods.best.poses import scored_poses
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import CompressOptions
from kernel_fixtures import large_budget, open_form
from known_search import AT, BYTES, EFFORT, FakeRounds, KnownSearch, World, powers, search
from synthetic import make_camera, random_scene
from tiny_project import make_project

POINTS = np.random.default_rng(4).uniform(-1, 1, (3, 400))


def around(degrees: float, distance: float = 6.0) -> Camera:
    """A camera on a circle round the points that looks at their middle."""
    angle = math.radians(degrees)
    forward = np.array([-math.sin(angle), 0.0, -math.cos(angle)])
    rotation = np.stack([np.array([-math.cos(angle), 0.0, math.sin(angle)]), [0.0, 1.0, 0.0], forward])
    return make_camera(40, 40, focal=100, rotation=rotation, translation=(0, 0, distance), name=f"{degrees:g}")


def needed(given: list[Camera], rest: list[Camera] = [], deciding: list[Camera] = []) -> list[str]:  # noqa: B006
    return [camera.name for camera in needed_poses(given, given, rest, deciding, POINTS, 0.1)]


def test_dense_poses_need_no_others() -> None:
    given = [around(5.0 * place) for place in range(72)]
    assert needed(given, rest=[around(2.5)], deciding=[around(7.5)]) == []


def test_a_gap_between_given_poses_is_filled() -> None:
    """A pose 50 degrees from two groups. Within these nothing is needed."""
    near, far = [around(2.0 * place) for place in range(5)], [around(108.0 + 2.0 * place) for place in range(5)]
    assert needed(near) == needed(far) == []
    found = needed([*near, around(58.0), *far])
    assert found and all("58" in name.split(" to ") for name in found)


def test_given_poses_beyond_the_scored_ones_come_as_they_are() -> None:
    given = [around(0.1 * place) for place in range(9)]
    assert needed(given, rest=[around(90.0), around(0.5)]) == ["90"]


def test_a_view_that_decides_gets_poses_half_way_to_it() -> None:
    given = [around(2.0 * place) for place in range(10)]
    assert needed(given) == []
    found = needed(given, deciding=[around(60.0)])
    assert found and all(name.endswith(" to 60") for name in found)


def test_poses_that_show_a_part_smaller_count_less() -> None:
    given = [around(4.0 * place, distance=6.0) for place in range(9)]
    assert needed(given, rest=[around(16.0, distance=5.0)]) == []
    closer = around(16.0, distance=2.5)
    assert needed(given, rest=[closer]) == [closer.name]


def test_needed_poses_are_limited() -> None:
    given = [around(80.0 * place) for place in range(2)]
    rest = [around(30.0 * place + 15.0) for place in range(12)]
    assert len(needed(given, rest=rest)) == MOST_TIMES * len(given)


def test_poses_beside_a_view_lie_half_way_to_its_neighbours() -> None:
    view, given = around(10.0), [around(degrees) for degrees in (200, 14, 2, 40, 24, 60, 190)]
    assert [camera.name for camera in poses_beside(view, given)] == ["14 to 10", "2 to 10", "24 to 10", "40 to 10"]
    assert poses_beside(view, []) == []
    assert len(poses_beside(view, [view, *given])) == BESIDE


def test_scored_poses_beside_lost_views_are_finer_each_time() -> None:
    given, view = [around(2.0 * place) for place in range(20)], around(13.0)
    # So few Gaussians that the poses are looked at as coarsely as they may.
    source, options = random_scene(20, 5), CompressOptions(effort="fast")
    renderer = Renderer(open_form("w16"), large_budget())

    def widths(lost: list[int]) -> dict[str, int]:
        found = scored_poses(given, options, renderer, source, deciding=[view], lost=lost).cameras
        return {camera.name: camera.width for camera in found if camera.name.endswith(" to 13")}

    assert not widths([])
    once, twice, often = widths([0]), widths([0, 0]), widths([0] * 9)
    assert set(once) == set(twice) == {"12 to 13", "14 to 13", "10 to 13", "16 to 13"}
    # 40 pixels: every second one of them, then all.
    assert set(once.values()) <= {19, 20} and set(twice.values()) == set(often.values()) == {40}
    lifted = replace(options, views_margin=False)
    assert not [
        camera.name
        for camera in scored_poses(given, lifted, renderer, source, deciding=[view], lost=[0]).cameras
        if " to " in camera.name
    ]


class Breaking(World):
    """A world whose last view of three loses `times` the mean."""

    def __init__(self, times: float) -> None:
        super().__init__(lambda m: (m / AT) ** 0.6, lambda m: BYTES * (m / AT) ** -0.45)
        self.times = times

    def measure(self, planes: dict[str, np.ndarray], estimate: bool = False) -> Measurement:
        found = super().measure(planes, estimate)
        drop = found.drop or 0.0
        worst = replace(found, drop=self.times * drop, modelled_drop=self.times * drop)
        rest = (3 - self.times) / 2 * drop
        return replace(found, worst=worst, usual=drop, losses=(rest, rest, self.times * drop))


def asking(world: World, target: Target) -> Any:
    rounds = FakeRounds()
    world.rounds, world.multiplier = rounds, None
    finder = KnownSearch(rounds, world.size_of, world.measure, EFFORT, refit=False)  # type: ignore[arg-type]
    finder.world, finder.asks = world, True
    return finder


PROMISED = Promised(MaxDrop(1.0), (WorstView("drop", 1.7),))


def test_candidates_in_a_row_that_break_a_view_ask_for_poses() -> None:
    with pytest.raises(PosesLacking) as caught:
        asking(Breaking(40.0), PROMISED).run(PROMISED)
    assert caught.value.views == (2,) and len(caught.value.steps) == BROKEN
    assert all(broken_views(PROMISED, step.measurement) == [2] for step in caught.value.steps)


class Freeing(KnownSearch):
    """Counts what the search frees."""

    freed = 0

    def discard(self, product: Any) -> None:
        self.freed += 1


def test_a_search_that_asks_frees_its_products() -> None:
    world, rounds = Breaking(40.0), FakeRounds()
    world.rounds = rounds
    finder = Freeing(rounds, world.size_of, world.measure, EFFORT, refit=False)  # type: ignore[arg-type]
    finder.world, finder.asks = world, True
    with pytest.raises(PosesLacking):
        finder.run(PROMISED)
    assert finder.freed == BROKEN


def test_a_search_with_a_result_that_holds_does_not_ask() -> None:
    """Two candidates break a view. With one that holds before them, the search keeps that one."""
    world = Breaking(40.0)
    finder = asking(world, PROMISED)
    found = search(powers(), MaxDrop(0.5), best_effort=True).chosen
    holding = replace(found, excess=-0.5, measurement=replace(found.measurement, losses=(0.1, 0.1, 0.1)))
    missed = [step for step in broken_steps(world) if not step.holds]
    assert finder._broken(missed, PROMISED) == [2] and finder._broken([holding, *missed], PROMISED) == []


def broken_steps(world: World) -> list[Any]:
    with pytest.raises(PosesLacking) as caught:
        asking(world, PROMISED).run(PROMISED)
    return list(caught.value.steps)


@pytest.mark.parametrize(
    ("world", "target"),
    [
        (Breaking(1.2), PROMISED),
        (powers(), PROMISED),
        (Breaking(40.0), MaxDrop(1.0)),
        (Breaking(40.0), Promised(MaxSize(3000, "drop"), (WorstView("drop", 1.7),))),
    ],
)
def test_others_do_not_ask(world: World, target: Target) -> None:
    assert asking(world, target).run(target).reached


def test_broken_views_are_those_beyond_the_bound() -> None:
    point = Measurement(1.0, 40.0, 1.0, usual=1.0, losses=(1.69, None, 1.71, -0.2))
    assert broken_views(PROMISED, point) == [2]
    assert broken_views(Promised(MaxDrop(1.0), (WorstView("drop", 0.5),)), point) == [0, 2]
    assert broken_views(MaxDrop(1.0), point) == []


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene") / "point_cloud.ply"


WORDS: dict[str, Any] = {"effort": "fast", "holdout": 4, "max_drop": 2.0, "max_worst_drop": 0.3}


def test_a_search_begins_anew_with_more_poses(
    project: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO", "flexgs_edge")
    result = compress(project, tmp_path / "a.fgs", **WORDS)
    words = [record.getMessage() for record in caplog.records]
    assert sum("searching again with poses beside them" in word for word in words) in (1, 2)
    assert result.promise is not None and result.promise.held and result.search is not None
    # Candidates of all searches are told.
    assert len(result.search.steps) == sum(word.startswith("multiplier: ") for word in words) > BROKEN
    monkeypatch.setattr("flexgs_edge.methods.best.method.SEARCHES", 1)
    once = compress(project, tmp_path / "b.fgs", **WORDS)
    assert once.scored is not None and result.scored is not None and once.scored.made < result.scored.made


def test_another_search_depends_neither_on_memory_nor_on_a_stop(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = tmp_path / "a.fgs"
    compress(project, expected, **WORDS)
    compress(project, tmp_path / "b.fgs", memory_limit=current_rss() + 400 * 2**20, **WORDS)
    assert (tmp_path / "b.fgs").read_bytes() == expected.read_bytes()
    kept = {**WORDS, "resume": True, "scratch": str(tmp_path)}

    def stop(*words: Any) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        # The first search has asked for more poses, and the second one has begun.
        patch.setattr("flexgs_edge.methods.best.checkpoint.Checkpoint.further", stop)
        with pytest.raises(KeyboardInterrupt):
            compress(project, tmp_path / "c.fgs", **kept)
    assert list(tmp_path.glob(".flexgs-resume-*/round-0"))
    compress(project, tmp_path / "c.fgs", **kept)
    assert (tmp_path / "c.fgs").read_bytes() == expected.read_bytes()
    assert not list(tmp_path.glob(".flexgs-resume-*"))
