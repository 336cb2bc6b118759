"""What nerfstudio writes of a training: frames under outputs/, and the list of poses of ns-export cameras."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_files import opengl_matrix, write_inria, write_transforms
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.run.inputs import companions_of
from synthetic import look_from, make_camera

SHIFT = {"transform": [[1.0, 0, 0, 2], [0, 1, 0, 0], [0, 0, 1, 0]], "scale": 0.5}
OTHER = {**SHIFT, "scale": 0.25}


def cameras(count: int = 3, **changes: Any) -> list[Camera]:
    poses = [look_from(index) for index in range(count)]
    return [
        make_camera(48, 32, rotation=r, translation=t, name=f"{i}.jpg", **changes) for i, (r, t) in enumerate(poses)
    ]


def training(root: Path, experiment: str, value: dict[str, Any], time: str = "2026-01-01") -> Path:
    folder = root / "outputs" / experiment / "splatfacto" / time
    folder.mkdir(parents=True)
    (folder / "dataparser_transforms.json").write_text(json.dumps(value))
    return folder


def pose_list(path: Path, poses: list[Camera], folder: str = "images/") -> Path:
    path.write_text(json.dumps([{"file_path": folder + c.name, "transform": opengl_matrix(c)[:3]} for c in poses]))
    return path


def data_in(root: Path) -> Path:
    (root / "data" / "pot").mkdir(parents=True)
    return write_transforms(root / "data" / "pot" / "transforms.json", cameras())


def assert_moved(read: list[Camera], moved: bool = True) -> None:
    for ours, theirs in zip(read, cameras(), strict=True):
        expected = (theirs.center + np.array([2, 0, 0])) * 0.5 if moved else theirs.center
        np.testing.assert_allclose(ours.center, expected, atol=1e-9)


@pytest.mark.parametrize("level", ["data/pot", "data", "."])
def test_the_frame_under_outputs(tmp_path: Path, level: str) -> None:
    path = data_in(tmp_path)
    training(tmp_path / level, "pot", SHIFT)
    training(tmp_path / level, "pot", SHIFT, "2026-01-02")  # the same frame again is no doubt
    assert_moved(read_cameras(path))


def test_trainings_of_other_data_do_not_count(tmp_path: Path) -> None:
    path = data_in(tmp_path)
    other = training(tmp_path, "other", SHIFT)
    assert_moved(read_cameras(path), moved=False)
    (other / "config.yml").write_text("data: &id003 !!python/object/apply:pathlib.PosixPath\n- data\n- pot\n")
    assert_moved(read_cameras(path))


def test_frames_that_differ_are_named(tmp_path: Path) -> None:
    path = data_in(tmp_path)
    found = [training(tmp_path, "pot", SHIFT), training(tmp_path, "pot", OTHER, "2026-01-02")]
    with pytest.raises(InputError, match="2 trainings of it have frames that differ.*--dataparser FILE") as caught:
        read_cameras(path)
    assert all(str(folder) in str(caught.value) for folder in found)
    assert_moved(read_cameras(path, dataparser=found[0] / "dataparser_transforms.json"))
    with pytest.raises(InputError, match="cannot read"):
        read_cameras(path, dataparser=tmp_path / "none.json")


def test_the_frame_above_the_scene(tmp_path: Path) -> None:
    folder = training(tmp_path, "pot", SHIFT)
    (folder / "exports" / "splat").mkdir(parents=True)
    (folder / "exports" / "splat" / "splat.ply").touch()
    assert companions_of(folder / "exports/splat/splat.ply").dataparser == folder / "dataparser_transforms.json"


@pytest.mark.parametrize("beside", ["transforms.json", "cameras.json"])
def test_a_list_of_poses_takes_lenses_from_beside(tmp_path: Path, beside: str) -> None:
    {"transforms.json": write_transforms, "cameras.json": write_inria}[beside](tmp_path / beside, cameras())
    path = pose_list(tmp_path / "transforms_train.json", cameras()[:2], "/far/away/images/")
    for ours, theirs in zip(read_cameras(path), cameras()[:2], strict=True):
        np.testing.assert_allclose(ours.center, theirs.center, atol=1e-9)
        np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=1e-9)
        assert (ours.name, ours.width, ours.fx, ours.distortion) == (theirs.name, 48, theirs.fx, None)


def test_a_list_of_poses_alone(tmp_path: Path) -> None:
    path = pose_list(tmp_path / "poses.json", cameras())
    read = read_cameras(path)
    assert (read[0].width, read[0].height) == (640, 480) and read[0].fx == pytest.approx(320 / np.tan(np.radians(32.5)))
    with pytest.raises(InputError, match="an assumed field of view of 65 degrees.*transforms.json"):
        Photos.open(tmp_path, read)


def test_lists_of_poses_that_cannot_be_read(tmp_path: Path) -> None:
    write_inria(tmp_path / "cameras.json", [make_camera(48, 32, name="x"), make_camera(64, 32, name="y")])
    path = pose_list(tmp_path / "poses.json", cameras())
    with pytest.raises(InputError, match="camera 0: no size and focal length: no camera beside .* '0'"):
        read_cameras(path)
    path.write_text(json.dumps([{"file_path": "a", "transform": [[1, 2]]}]))
    with pytest.raises(FormatError, match="camera 0: transform: expected 3 x 4 finite numbers"):
        (tmp_path / "cameras.json").unlink()
        read_cameras(path)
