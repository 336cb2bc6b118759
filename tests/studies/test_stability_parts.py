"""Parts of the study of stability: what it changes in a scene, where it looks from, and how its charts show breaks."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.quality.psnr import mse
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.plots import BarChart, LineChart, Series, draw
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.stability import moves, removal, strays, unseen_poses
from flexgs_edge.studies.stability.baselines import half_positions, tensor_rounded
from flexgs_edge.studies.stability.moved_scene import NO_TURN, Similarity
from flexgs_edge.views.depths import visible_depths
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, make_splats, random_scene


def test_breaks_are_crossed_out_in_charts() -> None:
    broken = Series("a", [1.0, 2.0], [0.5, 4.0], broken=[2.0])
    failed = Series("b", [1.0, 2.0], [0.5, None], broken=[2.0])
    (axes,) = draw(LineChart("t", "x", "y", (broken, failed), limit=3.0)).axes
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [line.get_ydata()[0] for line in crosses] == [4.0, 0.98]
    (axes,) = draw(BarChart("t", "y", ["one", "two"], {"a": [1.0, 4.0]}, limit=3.0)).axes
    assert [text.get_text() for text in axes.texts] == ["1.00", "\N{MULTIPLICATION SIGN}\n4.00"]


def test_one_range_for_a_tensor() -> None:
    source = random_scene(60, 3, 1)
    size, rounded = tensor_rounded(source, 4)
    planes, given = (one.read(slice(0, 60), list(FIELD)) for one in (rounded, source))
    for name, values in planes.items():
        assert len(np.unique(values)) <= 16
        step = np.ptp(given[name]) / 15
        assert np.abs(values - given[name]).max() <= step / 2 * (1 + 1e-5)
    # 23 channels of 60 codes of 4 bits, and a range for each of the six attributes.
    assert size == 23 * 30 + 6 * 8


def test_half_precision_of_the_world_and_not_of_the_scene() -> None:
    near, far = random_scene(50, 4), random_scene(50, 4, origin=(1e5, 0.0, 0.0))
    errors = []
    for source in (near, far):
        moved = (
            half_positions(source).read(slice(0, 50), ["means"])["means"]
            - source.read(slice(0, 50), ["means"])["means"]
        )
        errors.append(float(np.abs(moved[0]).max()))
    assert errors[0] < 1e-3 < 10 < errors[1]


def test_other_poses_look_at_the_same_point() -> None:
    rotation, translation = look_from(2)
    camera = make_camera(90, 70, rotation=rotation, translation=translation)
    depth = 3.0
    point = camera.center + depth * camera.rotation[2]

    def seen(pose: object) -> np.ndarray:
        return pose.rotation @ point + pose.translation  # type: ignore[attr-defined]

    turned = unseen_poses.above(camera, depth, 30.0)
    np.testing.assert_allclose(seen(turned), [0, 0, depth], atol=1e-12)
    assert math.degrees(math.acos(turned.rotation[2] @ camera.rotation[2])) == pytest.approx(30.0)
    # Above: the image's down component of the way there is negative.
    assert (camera.rotation @ (turned.center - camera.center))[1] < 0


def test_depth_of_what_is_seen_and_not_of_what_it_hides() -> None:
    means = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 9.0], [1.4, 0.0, 5.0]])
    source = make_splats(means, np.full((3, 3), 0.4), opacity=0.99)
    assert visible_depths(Renderer(open_form("w8"), large_budget()), source, [make_camera(40, 30)]) == [
        pytest.approx(3.0)
    ]


def test_the_worst_tile() -> None:
    image, reference = np.zeros((100, 70, 3), np.float32), np.zeros((100, 70, 3), np.float32)
    image[70:, 66:] = 0.5  # wholly inside the tile at the corner, 36 x 6 pixels of it
    assert unseen_poses.worst_tile(image, reference) == pytest.approx(0.25 * (30 * 4) / (36 * 6))
    assert unseen_poses.worst_tile(image, reference, side=1000) == pytest.approx(mse(image, reference))


def test_strays_are_where_no_camera_looks() -> None:
    cameras = [make_camera(90, 70, rotation=look_from(i)[0], translation=look_from(i)[1]) for i in range(6)]
    source = random_scene(300, 5, 1)
    planes = source.read(slice(0, 300), list(FIELD))
    far = 1e3 * float(planes["means"].std(axis=1).max())
    direction = strays.unseen_direction(cameras, np.median(planes["means"], axis=1), far)
    assert direction is not None
    added = strays.strays_of(planes, 1e3, direction)
    assert {name: values.shape[1] for name, values in added.items()} == dict.fromkeys(FIELD, 5)
    renderer = Renderer(open_form("w8"), large_budget())
    pictures = []
    for parts in ((planes,), (planes, added)):
        joined = {name: np.concatenate([part[name] for part in parts], axis=1) for name in FIELD}
        with renderer.load(MemorySource(joined)) as scene:
            pictures.append([renderer.render(scene, camera) for camera in cameras])
    renderer.release()
    for before, after in zip(*pictures):
        np.testing.assert_array_equal(before, after)
    # Views all around: there is no such place.
    turns = [np.eye(3)[list(p)] * s for p in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) for s in (1.0, -1.0)]
    around = [make_camera(90, 90, focal=20.0, rotation=turn) for turn in turns]
    assert strays.unseen_direction(around, np.zeros(3), 100.0) is None


def test_halves_of_a_path() -> None:
    line = [make_camera(translation=(-x, 0.0, 0.0)) for x in (0.0, 1.0, 2.0, 7.0)]
    axis, middle = removal.longest_axis(line)
    sides = removal.half_of(line, axis, middle)
    assert abs(axis[0]) == pytest.approx(1.0) and sides.sum() == 2 and sides[0] == sides[1] != sides[2]


@pytest.mark.parametrize("wide", [False, True])
def test_a_moved_file_keeps_the_digits_that_its_type_has(tmp_path: Path, wide: bool) -> None:
    source = random_scene(200, 6, 1)
    move = Similarity(1.0, NO_TURN, 1e3 * moves.AWAY)
    found = moves.moved_file(source, move, wide, tmp_path / "moved.ply")
    assert b"double x" in (tmp_path / "moved.ply").read_bytes()[:400] if wide else True
    world = found.read(slice(0, 200), ["means"])["means"].astype(np.float64) + found.origin[:, None]
    given = source.read(slice(0, 200), ["means"])["means"].astype(np.float64) + move.shift[:, None]
    apart = float(np.abs(world - given).max())
    # Half a unit of the last place of 640 in float32, 3.1e-5; relative to an origin near by, a thousandth of that.
    assert apart < 1e-6 if wide else 1e-5 < apart < 3.2e-5
    assert np.any(found.origin != 0) or not wide
