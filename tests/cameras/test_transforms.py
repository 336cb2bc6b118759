"""NeRF's and nerfstudio's transforms.json: axes, frames of training, sizes and focal lengths, lenses, malformations."""

from __future__ import annotations

import copy
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from camera_files import colmap_records, read_transforms, transforms_of, write_colmap, write_inria, write_transforms
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import FormatError, InputError
from synthetic import look_from, make_camera

# A camera at (1, 2, 3) that looks along the world's x, its image's top towards z (OpenGL: columns right, up, backwards).
MATRIX = [[0.0, 0.0, -1.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 1.0, 0.0, 3.0], [0.0, 0.0, 0.0, 1.0]]


def frame(name: str = "images/a.jpg", **changes: Any) -> dict[str, Any]:
    return {"file_path": name, "transform_matrix": MATRIX, **changes}


def document(*frames: dict[str, Any], **changes: Any) -> dict[str, Any]:
    base = {"w": 64, "h": 48, "fl_x": 50.0, "fl_y": 55.0, "cx": 32.0, "cy": 24.5, "frames": list(frames or [frame()])}
    return {key: value for key, value in {**base, **changes}.items() if value is not None}


def write(folder: Path, value: Any, name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(value))
    return folder / name


def cameras(count: int = 3) -> list[Camera]:
    made = []
    for index in range(count):
        rotation, translation = look_from(index)
        made.append(make_camera(48, 32, rotation=rotation, translation=translation, name=f"{index}.jpg"))
    return made


def assert_same(ours: Camera, theirs: Camera, atol: float = 1e-12) -> None:
    np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=atol)
    np.testing.assert_allclose(ours.translation, theirs.translation, atol=atol)
    assert (ours.name, ours.width, ours.height) == (theirs.name, theirs.width, theirs.height)
    found, expected = ((c.fx, c.fy, c.cx, c.cy) for c in (ours, theirs))
    np.testing.assert_allclose(found, expected, atol=atol)


def test_the_convention(tmp_path: Path) -> None:
    (camera,) = read_transforms(write(tmp_path, document()))
    assert (camera.name, camera.width, camera.height, camera.fx, camera.fy) == ("a.jpg", 64, 48, 50.0, 55.0)
    assert (camera.cx, camera.cy, camera.distortion) == (31.5, 24.0, None)
    np.testing.assert_array_equal(camera.center, [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(camera.rotation[2], [1.0, 0.0, 0.0])  # forward
    np.testing.assert_array_equal(camera.rotation[1], [0.0, 0.0, -1.0])  # down


def test_one_scene_in_every_format(tmp_path: Path) -> None:
    written = cameras()
    (tmp_path / "inria").mkdir()
    (tmp_path / "nerf").mkdir()
    write_inria(tmp_path / "inria" / "cameras.json", written)
    write_transforms(tmp_path / "nerf" / "transforms.json", written)
    write_colmap(tmp_path / "text", *colmap_records(written), text=True)
    write_colmap(tmp_path / "binary", *colmap_records(written))
    for kind in ("inria", "nerf", "text", "binary"):
        for ours, theirs in zip(read_cameras(tmp_path / kind), written, strict=True):
            assert_same(ours, theirs)


@pytest.mark.parametrize("rows", [3, 4])
def test_the_frame_of_the_training(tmp_path: Path, rows: int) -> None:
    """A nerfstudio export: poses behind applied_transform and applied_scale, the PLY behind dataparser_transforms.json."""
    turn_a, turn_t = look_from(11)[0], look_from(12)[0]
    move_a, move_t = np.array([0.5, -1.0, 2.0]), np.array([-3.0, 0.25, 1.0])
    original = cameras()
    # x' = A x + a as `ns-process-data` applies it, x'' = s (T x' + t) as the training does; the file stores T A and T a + t.
    scale = 0.37

    def moved(camera: Camera, turn: np.ndarray, move: np.ndarray, factor: float) -> Camera:
        rotation = camera.rotation @ turn.T
        centre = factor * (turn @ camera.center + move)
        return make_camera(
            camera.width, camera.height, rotation=rotation, translation=tuple(-rotation @ centre), name=camera.name
        )

    stored = [moved(camera, turn_a, move_a, 1.0) for camera in original]
    expected = [moved(camera, turn_t, move_t, scale) for camera in stored]
    applied = np.column_stack([turn_a, move_a]).tolist()
    whole = np.column_stack([turn_t @ turn_a, turn_t @ move_a + move_t])
    matrix = np.vstack([whole, [[0, 0, 0, 1]]])[:rows].tolist()
    write_transforms(tmp_path / "transforms.json", stored, applied_transform=applied)
    for ours, theirs in zip(read_cameras(tmp_path), stored):
        assert_same(ours, theirs, 1e-11)
    write(tmp_path, {"transform": matrix, "scale": scale}, "dataparser_transforms.json")
    for path in (tmp_path, tmp_path / "transforms.json"):
        for ours, theirs in zip(read_cameras(path), expected, strict=True):
            assert_same(ours, theirs, 1e-11)
    # A scale applied before is part of the file's `scale`.
    write(tmp_path, {"transform": matrix, "scale": scale * 4}, "dataparser_transforms.json")
    write_transforms(tmp_path / "transforms.json", stored, applied_transform=applied, applied_scale=4.0)
    for ours, theirs in zip(read_cameras(tmp_path), expected, strict=True):
        assert_same(ours, theirs, 1e-11)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ({"scale": 1.0}, "missing key 'transform'"),
        ({"transform": MATRIX[:3]}, "missing key 'scale'"),
        ({"transform": MATRIX[:3], "scale": 0.0}, "scale: expected a factor above 0, found 0"),
        ({"transform": MATRIX[:2], "scale": 1.0}, "transform: expected 3 x 4 finite numbers"),
        ({"transform": (2 * np.array(MATRIX[:3])).tolist(), "scale": 1.0}, "transform: expected an orthonormal matrix"),
        ([], "expected an object, found a list"),
    ],
)
def test_a_bad_frame_of_the_training(tmp_path: Path, value: Any, words: str) -> None:
    write(tmp_path, document())
    write(tmp_path, value, "dataparser_transforms.json")
    with pytest.raises(FormatError, match=f"dataparser_transforms.json: {words}"):
        read_cameras(tmp_path)


def test_focal_lengths_from_wherever_they_are(tmp_path: Path) -> None:
    angle = 2 * math.atan(32 / 40.0)
    for changes, expected in (
        ({"fl_x": None, "fl_y": None, "camera_angle_x": angle}, (40.0, 40.0)),
        ({"fl_y": None}, (50.0, 50.0)),
        ({"fl_x": None}, (55.0, 55.0)),
        (
            {"fl_x": None, "fl_y": None, "camera_angle_x": angle, "camera_angle_y": 2 * math.atan(24 / 70.0)},
            (40.0, 70.0),
        ),
        ({"camera_angle_x": 0.1}, (50.0, 55.0)),
    ):
        (camera,) = read_transforms(write(tmp_path, document(**changes)))
        np.testing.assert_allclose((camera.fx, camera.fy), expected, rtol=1e-12)
    (camera,) = read_transforms(write(tmp_path, document(cx=None, cy=None)))
    assert (camera.cx, camera.cy) == (31.5, 23.5)
    own = frame(fl_x=20.0, fl_y=21.0, cx=1.0, cy=2.0, w=32, h=16)
    (camera,) = read_transforms(write(tmp_path, document(own)))
    assert (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy) == (32, 16, 20.0, 21.0, 0.5, 1.5)


def test_sizes_from_the_photos(tmp_path: Path) -> None:
    """NeRF's synthetic scenes: an angle, names without extension, and no sizes."""
    (tmp_path / "train").mkdir()
    for index in (0, 10, 2):
        Image.new("RGBA", (40, 20)).save(tmp_path / "train" / f"r_{index}.png")
    value = {"camera_angle_x": 2 * math.atan(0.5), "frames": [frame(f"./train/r_{i}") for i in (0, 2, 10)]}
    read = read_cameras(write(tmp_path, value, "transforms_train.json"))
    assert [camera.name for camera in read] == ["r_0", "r_10", "r_2"]
    assert {(camera.width, camera.height, round(camera.fx, 9), camera.cx) for camera in read} == {(40, 20, 40.0, 19.5)}
    assert [path.name for path in Photos.open(tmp_path / "train", read).paths] == ["r_0.png", "r_10.png", "r_2.png"]
    (tmp_path / "train" / "r_2.png").unlink()
    with pytest.raises(FormatError, match=r"frame 1: no size: expected keys 'w' and 'h', or the photo .*r_2"):
        read_cameras(tmp_path / "transforms_train.json")


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["images/a.jpg", "images/b.jpg"], ["a.jpg", "b.jpg"]),
        (["./images/a.jpg", "images/b.jpg"], ["a.jpg", "b.jpg"]),
        (["images/l/a.jpg", "images/r/a.jpg"], ["l/a.jpg", "r/a.jpg"]),
        (["..\\images\\a.jpg", "..\\images\\b.jpg"], ["a.jpg", "b.jpg"]),
        (["/data/x/a.jpg", "/data/y/a.jpg"], ["x/a.jpg", "y/a.jpg"]),
        (["a", "b"], ["a", "b"]),
        (["a/b", "c"], ["a/b", "c"]),
    ],
)
def test_names_are_paths_below_the_shared_folder(tmp_path: Path, paths: list[str], names: list[str]) -> None:
    read = read_transforms(write(tmp_path, document(*[frame(path) for path in paths])))
    assert [camera.name for camera in read] == names


@pytest.mark.parametrize(
    ("changes", "lens"),
    [
        ({"k1": 0.1}, "k1 = 0.1"),
        ({"k1": 0.1, "p2": -1e-9}, "k1 = 0.1, p2 = -1e-09"),
        ({"camera_model": "OPENCV_FISHEYE"}, "camera_model OPENCV_FISHEYE"),
        ({"is_fisheye": True}, "camera_model OPENCV_FISHEYE"),
    ],
)
def test_lenses_that_distort(tmp_path: Path, changes: dict[str, Any], lens: str) -> None:
    for value in (document(**changes), document(frame(**changes))):
        (straight,) = read_cameras(write(tmp_path, value))
        assert straight.lens is not None and straight.lens.fisheye == ("FISHEYE" in lens)
        (camera,) = read_cameras(tmp_path, ignore_distortion=True)
        assert camera.distortion == f"lens distortion ({lens})"
        with pytest.raises(InputError, match="photos cannot be compared"):
            Photos.open(tmp_path, [camera])


def test_lenses_that_do_not_distort(tmp_path: Path) -> None:
    for changes in ({"k1": 0, "k2": 0.0, "is_fisheye": False}, {"camera_model": "PINHOLE"}, {"camera_model": "OPENCV"}):
        assert read_cameras(write(tmp_path, document(**changes)))[0].distortion is None
    with pytest.raises(InputError, match="camera_model: expected PINHOLE or OPENCV, found 'EQUIRECTANGULAR'"):
        read_cameras(write(tmp_path, document(camera_model="EQUIRECTANGULAR")), ignore_distortion=True)


NAN = float("nan")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"file_path": 3}, "frame 1: file_path: expected a name, found 3"),
        ({"transform_matrix": None}, "frame 1: transform_matrix: expected 3 x 4 finite numbers"),
        ({"transform_matrix": MATRIX[:2]}, "transform_matrix: expected 3 x 4 finite numbers"),
        ({"transform_matrix": [*MATRIX[:3], [0, 0, 0, 2]]}, "expected 0 0 0 1 as the last row, found 0 0 0 2"),
        ({"transform_matrix": [[1.002, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "expected an orthonormal matrix"),
        ({"transform_matrix": [[-1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "found a reflection"),
        ({"transform_matrix": [[NAN, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]}, "expected 3 x 4 finite numbers"),
        ({"w": 0}, "frame 1: w: expected a whole number of pixels"),
        ({"h": 48.5}, "frame 1: h: expected a whole number of pixels"),
        ({"fl_x": 0}, "frame 1: fl_x: expected a focal length above 0 pixels, found 0"),
        ({"cx": NAN}, "frame 1: cx: expected a principal point in pixels, found nan"),
        ({"k1": "0"}, "frame 1: k1: expected a finite number, found a string"),
        ({"camera_model": 4}, "frame 1: camera_model: expected a name"),
    ],
)
def test_a_bad_value_is_named_with_its_place(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    path = write(tmp_path, copy.deepcopy(document(frame(), {**frame("images/b.jpg"), **changes})))
    with pytest.raises(FormatError, match=words) as caught:
        read_transforms(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("value", "words"),
    [
        ([], "expected an object, found a list"),
        ({}, "missing key 'frames'"),
        ({"frames": []}, "frames: expected a list of frames, found an empty one"),
        ({"frames": 3}, "frames: expected a list of frames, found a number"),
        ({"frames": [3]}, "frame 0: expected an object, found a number"),
        (document(fl_x=None, fl_y=None), "frame 0: no focal length"),
        (
            document(fl_x=None, fl_y=None, camera_angle_x=4.0),
            "camera_angle_x: expected an angle between 0 and pi, found 4",
        ),
        (document(w=None), "frame 0: no size"),
    ],
)
def test_files_that_are_no_transforms(tmp_path: Path, value: Any, words: str) -> None:
    with pytest.raises(FormatError, match=words):
        read_transforms(write(tmp_path, value))


def test_matrices_of_three_rows(tmp_path: Path) -> None:
    whole = read_transforms(write(tmp_path, document()))[0]
    assert_same(read_transforms(write(tmp_path, document({**frame(), "transform_matrix": MATRIX[:3]})))[0], whole)


def test_inria_comes_before_nerf_in_a_folder(tmp_path: Path) -> None:
    write_inria(tmp_path / "cameras.json", cameras(1))
    write(tmp_path, transforms_of(cameras(2)))
    assert len(read_cameras(tmp_path)) == 1 and len(read_cameras(tmp_path / "transforms.json")) == 2


def test_a_real_file_with_distortion(scenes_dir: Path) -> None:
    path = scenes_dir / "cameras" / "fox_transforms.json"
    if not path.is_file():
        pytest.skip(f"no {path}")
    lens = read_cameras(path)[0].lens
    assert lens is not None and lens.radial[:2] == (0.0578421, -0.0805099) and lens.zoom < 1.02
    read = read_cameras(path, ignore_distortion=True)
    assert len(read) == 67 and read[0].name == "0001.jpg" and (read[0].width, read[0].height) == (1080, 1920)
    # The undistorted scene was trained from these poses, those whose photos are there.
    by_name = {Path(camera.name).stem: camera for camera in read}
    for theirs in read_cameras(scenes_dir / "fox"):
        ours = by_name[Path(theirs.name).stem]
        np.testing.assert_allclose(ours.center, theirs.center, atol=1e-4)
        np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=1e-4)


def test_repeated_photos_get_the_place_of_their_frame(tmp_path: Path) -> None:
    path = write(tmp_path, document(frame(), frame("images/b.jpg"), frame()))
    assert [camera.name for camera in read_transforms(path)] == ["a.jpg#0", "b.jpg", "a.jpg#2"]
