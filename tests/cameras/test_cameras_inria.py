"""INRIA's cameras.json: the convention, and a table of malformations."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_files import read_inria
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import FormatError, InputError

TURN = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]


def entry(name: str = "a", **changes: Any) -> dict[str, Any]:
    base = {"id": 0, "img_name": name, "width": 64, "height": 48, "position": [1.0, 2.0, 3.0], "rotation": TURN}
    return {**base, "fx": 50.0, "fy": 55, **changes}


def write(path: Path, value: Any) -> Path:
    path.write_text(json.dumps(value))
    return path


def test_the_convention(tmp_path: Path) -> None:
    (camera,) = read_inria(write(tmp_path / "cameras.json", [entry()]))
    assert (camera.name, camera.width, camera.height, camera.fx, camera.fy) == ("a", 64, 48, 50.0, 55.0)
    assert (camera.cx, camera.cy) == (31.5, 23.5)
    np.testing.assert_array_equal(camera.center, [1.0, 2.0, 3.0])
    # Columns of the file's rotation are the camera's axes in the world: x right is (0, 1, 0) here.
    np.testing.assert_array_equal(camera.rotation[0], [0.0, 1.0, 0.0])
    np.testing.assert_array_equal(camera.rotation @ [1.0, 3.0, 3.0] + camera.translation, [1.0, 0.0, 0.0])


def test_cameras_are_sorted_by_name_the_file_order_is_kept_by_the_reader(tmp_path: Path) -> None:
    path = write(tmp_path / "cameras.json", [entry(name) for name in ("b", "a10", "B", "a9")])
    assert [camera.name for camera in read_inria(path)] == ["b", "a10", "B", "a9"]
    assert [camera.name for camera in read_cameras(path)] == ["B", "a10", "a9", "b"]


def test_whole_sizes_written_as_floats_and_nearly_exact_rotations_pass(tmp_path: Path) -> None:
    turn = (np.array(TURN) * 1.0004).tolist()
    (camera,) = read_inria(write(tmp_path / "cameras.json", [entry(width=64.0, rotation=turn)]))
    assert camera.width == 64 and isinstance(camera.width, int)


@pytest.mark.parametrize("key", ["img_name", "width", "height", "position", "rotation", "fx", "fy"])
def test_a_missing_key_is_named(tmp_path: Path, key: str) -> None:
    bad = entry("b")
    del bad[key]
    with pytest.raises(FormatError, match=f"cameras.json: camera 1: missing key '{key}'; found 'id'"):
        read_inria(write(tmp_path / "cameras.json", [entry(), bad]))


NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"img_name": 7}, "img_name: expected a name, found 7"),
        ({"img_name": " "}, "img_name: expected a name"),
        ({"width": 0}, "width: expected a whole number of pixels from 1 to 65535, found 0"),
        ({"width": -4}, "width: .* found -4"),
        ({"width": 64.5}, "width: .* found 64.5"),
        ({"width": NAN}, "width: .* found nan"),
        ({"width": INF}, "width: .* found inf"),
        ({"width": 70000}, "width: .* found 70000"),
        ({"height": "48"}, "height: .* found a string"),
        ({"height": True}, "height: .* found a boolean"),
        ({"height": None}, "height: .* found null"),
        ({"width": 10**400}, "width: .* found a number beyond float64"),
        ({"fx": 0}, "fx: expected a focal length above 0 pixels, found 0"),
        ({"fx": -50.0}, "fx: .* found -50"),
        ({"fy": NAN}, "fy: .* found nan"),
        ({"fy": INF}, "fy: .* found inf"),
        ({"fy": [1]}, "fy: .* found a list"),
        ({"position": [1.0, 2.0]}, r"position: expected 3 finite numbers, found \[1.0, 2.0\]"),
        ({"position": [1.0, 2.0, NAN]}, "position: expected 3 finite numbers"),
        ({"position": [1.0, 2.0, "3"]}, "position: expected 3 finite numbers"),
        ({"position": [1.0, 2.0, True]}, "position: expected 3 finite numbers"),
        ({"position": [1.0, 2.0, 10**400]}, "position: .* beyond float64"),
        ({"position": 5}, "position: expected 3 finite numbers, found 5"),
        ({"position": {"x": 1}}, "position: expected 3 finite numbers"),
        ({"rotation": TURN[:2]}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": [*TURN[:2], [0.0, 1.0]]}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": [*TURN[:2], [0.0, 0.0, [1.0]]]}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": [*TURN[:2], [0.0, 0.0, NAN]]}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": []}, "rotation: expected 3 x 3 finite numbers"),
        ({"rotation": np.zeros((3, 3)).tolist()}, r"rotation: expected an orthonormal matrix .* off by 1"),
        ({"rotation": (np.array(TURN) * 1.002).tolist()}, "rotation: expected an orthonormal matrix .* off by 0.004"),
        ({"rotation": (-np.array(TURN)).tolist()}, "rotation: expected a rotation .* found a reflection"),
    ],
)
def test_a_bad_value_is_named_with_its_place(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    path = write(tmp_path / "cameras.json", [entry(), copy.deepcopy(entry("b", **changes))])
    with pytest.raises(FormatError, match=words) as caught:
        read_inria(path)
    assert str(path) in str(caught.value) and "1" in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (b"", "not JSON: Expecting value in line 1, column 1"),
        (b'[{"id": 0},\n  oops]', "not JSON: .* in line 2, column 3"),
        (b"\xff\xfe\xff", "not JSON"),
        (b"[" * 100_000, "not JSON"),
        (b"[" + b"9" * 5000 + b"]", "not JSON|camera 0: expected an object, found a number"),
        (b"[]", "the list of cameras is empty"),
        (b"3", "expected a JSON list of cameras, found a number"),
        (b'{"frames": []}', "expected a JSON list of cameras, found an object; this looks like a NeRF transforms.json"),
        (b"[null]", "camera 0: expected an object, found null"),
        (b"[[]]", "camera 0: expected an object, found a list"),
        (b"[{}]", "camera 0: missing key 'img_name'; found none"),
    ],
)
def test_files_that_are_no_list_of_cameras(tmp_path: Path, text: bytes, words: str) -> None:
    path = tmp_path / "cameras.json"
    path.write_bytes(text)
    with pytest.raises(FormatError, match=words) as caught:
        read_inria(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("names", "read"),
    [
        (["r_0", "r_1", "r_0"], ["r_0#0", "r_0#2", "r_1"]),
        (["a", "a", "a#1"], ["a#0", "a#1#1", "a#1#2"]),
        (["a", "b", "a#1"], ["a", "a#1", "b"]),
    ],
)
def test_repeated_names_get_their_place_in_the_file(tmp_path: Path, names: list[str], read: list[str]) -> None:
    path = write(tmp_path / "cameras.json", [entry(name) for name in names])
    assert [camera.name for camera in read_cameras(path)] == read


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="cannot read the cameras"):
        read_inria(tmp_path)
