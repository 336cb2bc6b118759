"""Crops: which Gaussians lie inside, what a user may write, and what a command does with it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.api.scene import Scene
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.commands.info import info
from flexgs_edge.commands.view import view
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.reading import Reading, parse_crop
from flexgs_edge.run.inputs import checked_scene, load_scene
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.crop import GEOMETRY, Crop, cropped
from flexgs_edge.scene.source import MemorySource
from synthetic import random_scene
from tiny_project import make_project

TURNED = {"center": [1, 2, 3], "size": [2, 4, 6], "rotation": [np.cos(np.pi / 8), 0, 0, np.sin(np.pi / 8)]}
"""45 degrees about z: the first edge points to x and y."""


def inside(crop: Crop, means: Any, log_scales: Any = -9.0, quats: Any = (1, 0, 0, 0)) -> list[bool]:
    places = np.atleast_2d(np.array(means, np.float32)).T
    scales = np.broadcast_to(np.reshape(np.array(log_scales, np.float32), (-1, 1)), places.shape)
    turns = np.broadcast_to(np.array(quats, np.float32)[:, None], (4, places.shape[1]))
    found: list[bool] = crop.inside(dict(zip(GEOMETRY, (places, scales, turns), strict=True)), np.zeros(3)).tolist()
    return found


def test_centres_of_small_gaussians_decide() -> None:
    assert inside(parse_crop("-1,-2,-3,1,2,3"), [(0, 0, 0), (0.9, 1.9, 2.9), (1.1, 0, 0), (0, -2.1, 0)]) == [1, 1, 0, 0]
    assert inside(parse_crop("1 1 1 2"), [(1, 1, 2.9), (1, 1, 3.1), (2.5, 2.5, 1), (1, 1, 1)]) == [1, 0, 0, 1]


def test_half_of_a_large_gaussian_must_lie_inside() -> None:
    """Twice as wide as the box, it lies mostly outside; long along one axis, that axis decides, in any turn."""
    box, sphere = parse_crop("-1,-1,-1,1,1,1"), parse_crop("0,0,0,1")
    for crop in (box, sphere):
        assert inside(crop, (0, 0, 0), np.log(0.4)) == [True] and inside(crop, (0, 0, 0), np.log(2.0)) == [False]
        assert inside(crop, (0.9, 0, 0), np.log([0.01, 0.2, 0.2])) == [True]
        assert inside(crop, (0.9, 0, 0), np.log([0.01, 3, 0.2])) == [False]
        assert inside(crop, (0.9, 0, 0), np.log([0.01, 0.2, 0.2]), (1, 0, 0, 1)) == [True]
    # Of a needle that reaches out at one end, half lies inside as long as its centre does.
    assert inside(box, [(0.95, 0, 0), (1.05, 0, 0)], np.log([0.3, 0.01, 0.01])) == [True, False]
    assert inside(box, [(0.95, 0, 0)], np.log([0.01, 0.3, 0.01]), (1, 0, 0, 1)) == [True]


def test_shares_are_those_of_many_samples() -> None:
    """Near half, where it matters, against a million points."""
    rng = np.random.default_rng(3)
    scales, centre = np.log([0.5, 0.7, 0.3]), (0.5, 0.3, -0.2)
    points = centre + rng.normal(size=(1_000_000, 3)) * np.exp(scales)
    for half in (0.5, 0.65, 0.95, 1.1):
        share = (np.abs(points) < half).all(axis=1).mean()
        assert abs(share - 0.5) > 0.05
        assert inside(Crop((0, 0, 0), (half,) * 3), centre, scales) == [share > 0.5], (half, share)


@pytest.mark.parametrize(
    "written",
    [
        TURNED,
        {"crop_center": [1, 2, 3], "crop_scale": [2, 4, 6], "crop_rot": [0, 0, np.pi / 4]},
        {"crop": {"crop_center": [1, 2, 3], "crop_scale": [2, 4, 6], "crop_rot": [0, 0, np.pi / 4]}},
        {"obb_center": [1, 2, 3], "obb_scale": [2, 4, 6], "obb_rotation": [0, 0, np.pi / 4]},
        {
            "center": [1, 2, 3],
            "size": [2, 4, 6],
            "axes": [[0.5**0.5, 0.5**0.5, 0], [-(0.5**0.5), 0.5**0.5, 0], [0, 0, 1]],
        },
        {
            "center": [1, -2, -3],
            "size": [2, 4, 6],
            "rotation": [np.cos(np.pi / 8), 0, 0, -np.sin(np.pi / 8)],
            "frame": "RUB",
        },
    ],
)
def test_turned_boxes(tmp_path: Path, written: dict[str, Any]) -> None:
    """The same box in our words and nerfstudio's, and in another frame."""
    place = tmp_path / "box.json"
    place.write_text(json.dumps(written))
    crop = parse_crop(str(place))
    s = 0.5**0.5
    corners = [(1 + 0.9 * s, 2 + 0.9 * s, 3), (1 - 1.9 * s, 2 + 1.9 * s, 3), (1, 2, 5.9), (1, 2, 6.1)]
    assert inside(crop, [*corners, (1 + 1.1 * s, 2 + 1.1 * s, 3)]) == [1, 1, 1, 0, 0]
    assert parse_crop_of(tmp_path, crop.to_json()) == crop


def parse_crop_of(folder: Path, value: Any) -> Crop:
    (folder / "again.json").write_text(json.dumps(value))
    return parse_crop(str(folder / "again.json"))


def test_spheres_and_corners_in_files(tmp_path: Path) -> None:
    assert parse_crop_of(tmp_path, {"center": [1, 2, 3], "radius": 2}) == parse_crop("1,2,3,2")
    assert parse_crop_of(tmp_path, {"min": [-1, 0, 1], "max": [1, 2, 5]}) == parse_crop("-1,0,1,1,2,5")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("1,2,3", r"expected six numbers \(two corners\), four"),
        ("1,2,3,4,5,6,7", "expected six numbers"),
        ("here.json", "no such file"),
        ("1,1,1,0,2,2", "a box of -1 x 1 x 1: expected edges above 0"),
        ("0,0,0,nan,1,1", "expected edges above 0"),
        ("0,0,0,-1", "a sphere of radius -1: expected a radius above 0"),
    ],
)
def test_what_is_no_crop(text: str, words: str) -> None:
    with pytest.raises(InputError, match=f"--crop {re.escape(text)}: .*{words}"):
        parse_crop(text)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([1], "expected a JSON object"),
        ({}, "size|scale"),
        ({"center": [0, 0], "radius": 1}, "center: expected 3 finite numbers"),
        ({"center": [0, 0, 0], "size": [1, 1, True]}, "size: expected 3 finite numbers"),
        ({"center": [0, 0, 0], "size": [1, 1, 1], "rotation": [0, 0, 0, 0]}, "rotation: expected a quaternion"),
        ({"center": [0, 0, 0], "size": [1, 1, 1], "axes": [[1, 0, 0], [1, 0, 0], [0, 0, 1]]}, "at right angles"),
        ({"center": [0, 0, 0], "size": [1, 1, 1], "axes": 3}, "axes: expected three directions"),
        ({"center": [0, 0, 0], "radius": 1, "frame": "XYZ"}, "expected three letters"),
        ({"center": [0, 0, 10**400], "radius": 1}, "center: expected 3 finite numbers"),
    ],
)
def test_files_that_hold_no_crop(tmp_path: Path, value: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        parse_crop_of(tmp_path, value)
    (tmp_path / "bad.json").write_text("{")
    with pytest.raises(InputError, match="not JSON"):
        parse_crop(str(tmp_path / "bad.json"))


def test_a_crop_that_holds_nothing_says_where_the_scene_lies() -> None:
    planes = random_scene(500, 3, 1).read(slice(0, 500), [*GEOMETRY, "opacity_logits", "sh_dc", "sh_rest"])
    planes["means"] += np.array([[5], [6], [7]], np.float32)
    scene = MemorySource(planes, origin=np.array([100.0, 0, 0]))
    with pytest.raises(
        InputError, match=r"holds none of 500 Gaussians; nine tenths of them lie within 10\d.* to 10\d"
    ) as error:
        cropped(scene, parse_crop("0,0,0,1"))
    assert "axes" not in str(error.value)
    with pytest.raises(InputError, match=r'With axes that point as RUB it holds \d+% .* file with "frame": "RUB"'):
        cropped(scene, parse_crop("95,-16,-17,115,-1,-1"))


def test_chunks_do_not_matter() -> None:
    scene, crop = random_scene(700, 5, 1), parse_crop("0,0,4,1")
    found = [cropped(scene, crop, chunk_rows=rows) for rows in (17, 700)]
    assert 0 < found[0].count < 700 and found[0].notes == found[1].notes
    for name in GEOMETRY:
        np.testing.assert_array_equal(*(part.read(slice(0, part.count), [name])[name] for part in found))


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("crop") / "scene")


def test_commands_work_on_what_is_inside(project: Path, tmp_path: Path) -> None:
    """One step gives the bytes of two; the photos are left out; the file knows its crop, and `evaluate` goes by it."""
    ply = project / "point_cloud.ply"
    box = "-1,-1,3,1,1,5"
    decompress(ply, tmp_path / "part.ply", reading=Reading(crop=parse_crop(box)))
    part = load_scene(tmp_path / "part.ply")
    whole = load_scene(ply)
    assert 0 < part.source.count < whole.source.count
    words: dict[str, Any] = {"effort": "fast", "cameras": str(project / "cameras.json")}
    one = compress(ply, tmp_path / "one.fgs", crop=box, **words)
    two = compress(tmp_path / "part.ply", tmp_path / "two.fgs", **words)
    assert (one.count, one.scene.count) == (two.count, part.source.count) and abs(one.size - two.size) < 200
    assert one.views is not None and one.views.images is None
    assert Scene.open(ply, crop=box).count == part.source.count == Scene.open(tmp_path / "part.ply").count
    against = evaluate(tmp_path / "one.fgs", ply, ViewOptions())
    assert against.quality.fidelity == pytest.approx(one.quality.fidelity, abs=0.1) and against.views.images is None
    shown = view(tmp_path / "one.fgs", tmp_path / "page.html", ViewOptions(crop="0,0,4,0.5"))
    assert 0 < shown.scene.count < one.count and view(tmp_path / "one.fgs", tmp_path / "all.html").size == one.size
    # A file that is not cropped is compared within the crop alone.
    whole = compress(ply, tmp_path / "whole.fgs", effort="fast", max_drop=0.1)
    within = evaluate(tmp_path / "whole.fgs", ply, ViewOptions(crop=box)).quality.fidelity
    assert whole.quality is not None and within is not None and within > 30
    with pytest.raises(InputError, match="--images: the scene is cropped, and photos show what lies beyond"):
        compress(ply, tmp_path / "no.fgs", crop=box, images=str(project / "images"), **words)


def test_info_counts_what_is_inside_and_shows_where_the_scene_lies(project: Path, tmp_path: Path) -> None:
    ply, crop = project / "point_cloud.ply", "-1,-1,3,1,1,5"
    whole, part = info(ply), info(ply, crop)
    assert part.count == load_scene(ply, reading=Reading(crop=parse_crop(crop))).source.count < whole.count
    assert whole.bounds is not None and part.bounds is not None
    assert all(-1.1 < low < high < 5.1 for low, high in zip(*part.bounds, strict=True))
    assert "bounds:      " in whole.summary() and "nine tenths" in whole.summary()
    compress(ply, tmp_path / "a.fgs", crop=crop, effort="fast", cameras=str(project / "cameras.json"))
    assert info(tmp_path / "a.fgs").settings["crop"] == parse_crop(crop).to_json()
    assert 0 < info(tmp_path / "a.fgs", "0,0,4,0.5").count < part.count


def test_a_damaged_crop_in_a_file_is_refused() -> None:
    scene = random_scene(50, 2, 0)
    scene.settings = {"crop": {"center": [0, 0, 0], "radius": -1}}
    with pytest.raises(FormatError, match="settings in the header: .*expected a radius above 0"):
        checked_scene(scene)


def test_photos_from_memory_do_not_go_with_a_crop(project: Path) -> None:
    photos = [np.zeros((4, 4, 3), np.uint8)]
    with pytest.raises(InputError, match="--images: the scene is cropped"):
        open_run(project / "point_cloud.ply", ViewOptions(crop="0,0,4,1"), given=GivenViews(images=photos))
