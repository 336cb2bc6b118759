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
from flexgs_edge.goals.promise import MeanSsim, Promised, WorstView, lost_views
from flexgs_edge.goals.target import MaxDrop, MaxSize, Measurement
from flexgs_edge.memory.process import current_rss
from flexgs_edge.methods.best.effort import LARGEST_STEP
from flexgs_edge.methods.best.poses import BESIDE, MOST_TIMES, needed_poses, poses_beside, scored_poses
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.options import CompressOptions
from kernel_fixtures import large_budget, open_form
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


def test_poses_beside_lost_views_are_finer_than_the_others() -> None:
    given, view = [around(2.0 * place) for place in range(20)], around(13.0)
    # So few Gaussians that the poses are looked at as coarsely as they may.
    source, renderer = random_scene(20, 5), Renderer(open_form("w16"), large_budget())
    poses = scored_poses(given, CompressOptions(effort="fast"), renderer, source, deciding=[view])
    assert list(poses.given) == sorted(given, key=poses.given.index) and poses.step == LARGEST_STEP
    found = poses.beside([view], renderer, source)
    assert {"12 to 13", "14 to 13", "10 to 13", "16 to 13"} <= {camera.name for camera in found}
    assert {camera.width for camera in found} <= {19, 20}  # of 40 pixels: every second one


PROMISED = Promised(MaxDrop(1.0), (WorstView("drop", 1.7), MeanSsim(0.015)))


def test_lost_views_are_those_far_beyond_the_bound_and_all_other_shares() -> None:
    point = Measurement(0.9, 40.0, 0.9, usual=1.0, ssim_drop=0.012, losses=(1.69, None, 2.2, 2.4, -0.2))
    assert lost_views(PROMISED, point) == [3]  # 1.5 times .9 times 1.7 dB
    assert lost_views(PROMISED, replace(point, ssim_drop=0.03)) == []
    assert lost_views(Promised(MaxDrop(9.0), (WorstView("drop", 0.5),)), point) == [0, 2, 3]
    assert lost_views(MaxDrop(1.0), point) == []
    assert lost_views(Promised(MaxSize(9, "drop"), PROMISED.parts), point) == []


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("tiny") / "scene") / "point_cloud.ply"


WORDS: dict[str, Any] = {"effort": "fast", "holdout": 4, "max_drop": 2.0, "max_worst_drop": 0.3}


def test_a_search_goes_on_with_more_poses(
    project: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level("INFO", "flexgs_edge")
    result = compress(project, tmp_path / "a.fgs", **WORDS)
    words = [record.getMessage() for record in caplog.records]
    assert sum("poses beside them are scored too" in word for word in words) in (1, 2)
    assert result.promise is not None and result.promise.held and result.search is not None
    assert len(result.search.steps) == sum(word.startswith("multiplier: ") for word in words) > 1
    monkeypatch.setattr("flexgs_edge.methods.best.rounds.MOST_PARTS", 1)
    once = compress(project, tmp_path / "b.fgs", **{**WORDS, "best_effort": True})
    assert once.scored is not None and result.scored is not None and once.scored.made < result.scored.made


class Stop(Exception):
    pass


def test_more_poses_depend_neither_on_memory_nor_on_a_stop(
    project: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    expected = tmp_path / "a.fgs"
    compress(project, expected, **WORDS)
    compress(project, tmp_path / "b.fgs", memory_limit=current_rss() + 400 * 2**20, **WORDS)
    assert (tmp_path / "b.fgs").read_bytes() == expected.read_bytes()
    kept = {**WORDS, "resume": True, "scratch": str(tmp_path)}

    def stop(*words: Any) -> None:
        raise Stop

    with monkeypatch.context() as patch:
        # A candidate has asked for more poses.
        patch.setattr("flexgs_edge.methods.best.rounds.PruneRounds.see", stop)
        with pytest.raises(Stop):
            compress(project, tmp_path / "c.fgs", **kept)
    assert list(tmp_path.glob(".flexgs-resume-*/round-0"))
    compress(project, tmp_path / "c.fgs", **kept)
    assert (tmp_path / "c.fgs").read_bytes() == expected.read_bytes()
    assert not list(tmp_path.glob(".flexgs-resume-*"))
