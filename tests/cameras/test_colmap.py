"""COLMAP's models: the convention, binary and text, lenses, every truncation, and a table of malformations."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from camera_files import (
    Image,
    Lens,
    colmap_records,
    images_binary,
    images_text,
    lenses_binary,
    lenses_text,
    write_colmap,
)
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.colmap import read_colmap
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import FormatError, InputError
from synthetic import look_from, make_camera

HALF = 0.7071067811865476
LENS: Lens = (1, "PINHOLE", 64, 48, (50.0, 55.0, 32.0, 24.5))
IMAGE: Image = (3, (HALF, 0.0, 0.0, HALF), (1.0, 2.0, 3.0), 1, "left/a.jpg")


def cameras() -> list[Camera]:
    made = []
    for index, name in enumerate(("b.jpg", "deep/er/a 1.png", "a.jpg")):
        rotation, translation = look_from(index)
        made.append(
            make_camera(40 + index, 30, rotation=rotation, translation=translation, name=name, centre=(19.25, 14.0))
        )
    return made


@pytest.mark.parametrize("text", [False, True])
def test_the_convention(tmp_path: Path, text: bool) -> None:
    (camera,) = read_colmap(write_colmap(tmp_path, [LENS], [IMAGE], text))
    assert (camera.name, camera.width, camera.height, camera.fx, camera.fy) == ("left/a.jpg", 64, 48, 50.0, 55.0)
    # The middle of 64 pixels is 32 where pixel centres lie at integer + 0.5, and 31.5 where they lie at integers.
    assert (camera.cx, camera.cy, camera.distortion) == (31.5, 24.0, None)
    np.testing.assert_allclose(camera.rotation, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-15)
    np.testing.assert_array_equal(camera.translation, [1.0, 2.0, 3.0])


@pytest.mark.parametrize("text", [False, True])
def test_poses_come_back(tmp_path: Path, text: bool) -> None:
    written = cameras()
    read = read_colmap(write_colmap(tmp_path, *colmap_records(written), text))
    assert [camera.name for camera in read] == ["b.jpg", "deep/er/a 1.png", "a.jpg"]
    for ours, theirs in zip(read, written):
        np.testing.assert_allclose(ours.rotation, theirs.rotation, atol=1e-12)
        np.testing.assert_allclose(ours.translation, theirs.translation, atol=1e-12)
        assert (ours.width, ours.height, ours.fx, ours.fy, ours.cx, ours.cy) == (
            theirs.width, theirs.height, theirs.fx, theirs.fy, theirs.cx, theirs.cy,
        )  # fmt: skip


@pytest.mark.parametrize("place", [".", "0", "sparse", "sparse/0", "colmap/sparse/0"])
@pytest.mark.parametrize("text", [False, True])
def test_the_model_is_found_in_its_folders(tmp_path: Path, place: str, text: bool) -> None:
    write_colmap(tmp_path / place, *colmap_records(cameras()), text)
    kind = "txt" if text else "bin"
    for path in (tmp_path, tmp_path / place, tmp_path / place / f"images.{kind}", tmp_path / place / f"cameras.{kind}"):
        assert [camera.name for camera in read_cameras(path)] == ["a.jpg", "b.jpg", "deep/er/a 1.png"]


def test_binary_comes_before_text(tmp_path: Path) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE], text=True)
    write_colmap(tmp_path, [LENS], [(*IMAGE[:4], "binary.jpg")])
    assert read_colmap(tmp_path)[0].name == "binary.jpg"


def test_a_model_without_its_other_half(tmp_path: Path) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE])
    (tmp_path / "images.bin").unlink()
    with pytest.raises(
        InputError, match=r"expected cameras and images, both .bin or both .txt; found cameras.bin only"
    ):
        read_cameras(tmp_path)
    (tmp_path / "cameras.bin").unlink()
    with pytest.raises(InputError, match="no COLMAP model here"):
        read_colmap(tmp_path)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("model", "parameters", "focals"),
    [
        ("SIMPLE_PINHOLE", (50.0, 32.0, 24.5), (50.0, 50.0)),
        ("SIMPLE_RADIAL", (50.0, 32.0, 24.5, 0.0), (50.0, 50.0)),
        ("OPENCV", (50.0, 55.0, 32.0, 24.5, 0.0, -0.0, 0.0, 0.0), (50.0, 55.0)),
        ("FOV", (50.0, 55.0, 32.0, 24.5, 0.0), (50.0, 55.0)),
    ],
)
def test_lenses_that_do_not_distort(
    tmp_path: Path, text: bool, model: str, parameters: tuple[float, ...], focals: tuple[float, float]
) -> None:
    (camera,) = read_colmap(write_colmap(tmp_path, [(1, model, 64, 48, parameters)], [IMAGE], text))
    assert ((camera.fx, camera.fy), camera.cx, camera.cy, camera.distortion) == (focals, 31.5, 24.0, None)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("model", "parameters"),
    [
        ("SIMPLE_RADIAL", (50.0, 32.0, 24.5, 1e-9)),
        ("OPENCV", (50.0, 55.0, 32.0, 24.5, 0.0, 0.0, 0.0, -0.1)),
        # A fisheye without distortion is no pinhole: angles, not tangents.
        ("OPENCV_FISHEYE", (50.0, 55.0, 32.0, 24.5, 0.0, 0.0, 0.0, 0.0)),
    ],
)
def test_lenses_that_distort(tmp_path: Path, text: bool, model: str, parameters: tuple[float, ...]) -> None:
    folder = write_colmap(tmp_path, [(1, model, 64, 48, parameters)], [IMAGE], text)
    (camera,) = read_cameras(folder, ignore_distortion=True)
    assert camera.distortion == f"lens distortion (COLMAP model {model})" and camera.fx == 50.0
    # The mark survives what is done to cameras, and photos are refused.
    for bent in (camera, camera.scaled(32, 24), camera.moved(np.ones(3))):
        with pytest.raises(InputError, match=r"photos cannot be compared: camera 'left/a.jpg' has lens distortion"):
            Photos.open(tmp_path, [bent])


def test_every_truncation_is_an_error(tmp_path: Path) -> None:
    lenses, images = colmap_records(cameras()[:2])
    for name, data in (("cameras.bin", lenses_binary(lenses)), ("images.bin", images_binary(images))):
        write_colmap(tmp_path, lenses, images)
        for length in range(len(data)):
            (tmp_path / name).write_bytes(data[:length])
            with pytest.raises(FormatError, match=name):
                read_colmap(tmp_path)
        (tmp_path / name).write_bytes(data + b"\0")
        with pytest.raises(FormatError, match=f"{name}: 1 bytes too many after the last"):
            read_colmap(tmp_path)


@pytest.mark.parametrize("count", [2, 2**32, 2**64 - 1])
def test_claims_are_checked_before_memory_is_taken(tmp_path: Path, count: int) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE])
    good = (tmp_path / "images.bin").read_bytes()
    (tmp_path / "images.bin").write_bytes(struct.pack("<Q", count) + good[8:])
    with pytest.raises(FormatError, match=r"images\.bin"):
        read_colmap(tmp_path)
    at = len(good) - 2 * 24 - 8
    (tmp_path / "images.bin").write_bytes(good[:at] + struct.pack("<Q", max(count, 3)) + good[at + 8 :])
    with pytest.raises(FormatError, match="points of image 0 of 24 bytes and more each, but only 48 bytes follow"):
        read_colmap(tmp_path)


NAN = float("nan")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    ("lenses", "images", "words"),
    [
        ([LENS], [], "the model has no images"),
        ([LENS], [(*IMAGE[:3], 2, "a")], "image 'a': camera 2 is not in cameras"),
        ([LENS, LENS], [IMAGE], "a second camera 1"),
        ([(1, "PINHOLE", 0, 48, LENS[4])], [IMAGE], "size: expected 1 to 65535 pixels a side, found 0x48"),
        ([(1, "PINHOLE", 64, 70000, LENS[4])], [IMAGE], "size: .* found 64x70000"),
        (
            [(1, "PINHOLE", 64, 48, (50.0, NAN, 1.0, 1.0))],
            [IMAGE],
            "parameters: expected finite numbers, found 50, nan",
        ),
        (
            [(1, "PINHOLE", 64, 48, (50.0, 0.0, 1.0, 1.0))],
            [IMAGE],
            "focal length: expected above 0 pixels, found 50, 0",
        ),
        (
            [(1, "EQUIRECTANGULAR", 64, 48, (1.0, 1.0, 1.0))],
            [IMAGE],
            "unknown camera model .*expected one of SIMPLE_PINHOLE",
        ),
        (
            [LENS],
            [(3, (0.5, 0.0, 0.0, 0.0), *IMAGE[2:])],
            "rotation: expected a unit quaternion, found one of norm 0.5",
        ),
        ([LENS], [(3, (0.0, 0.0, 0.0, 0.0), *IMAGE[2:])], "found one of norm 0"),
        ([LENS], [(3, (NAN, 0.0, 0.0, 0.0), *IMAGE[2:])], "pose: expected finite numbers"),
        ([LENS], [(3, IMAGE[1], (1.0, float("inf"), 0.0), *IMAGE[3:])], "pose: expected finite numbers"),
    ],
)
def test_bad_models(tmp_path: Path, text: bool, lenses: list[Lens], images: list[Image], words: str) -> None:
    with pytest.raises(FormatError, match=words) as caught:
        read_colmap(write_colmap(tmp_path, lenses, images, text))
    assert str(tmp_path) in str(caught.value)


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("cameras.txt", "1 PINHOLE 64\n", "expected CAMERA_ID MODEL WIDTH HEIGHT PARAMETERS"),
        ("cameras.txt", "1 PINHOLE 64 48 1 2 3\n", "model PINHOLE has 4 parameters, found 3"),
        ("cameras.txt", "1 PINHOLE 64 48 1 2 3 x\n", "expected numbers, found '1 2 3 x'"),
        ("cameras.txt", "-1 PINHOLE 64 48 1 2 3 4\n", "expected a whole number, found '-1'"),
        ("cameras.txt", "1 PINHOLE 64.5 48 1 2 3 4\n", "expected a whole number, found '64.5'"),
        ("cameras.txt", "\xff\xfe", "expected text in UTF-8|CAMERA_ID"),
        ("cameras.txt", "", "camera 1 is not in cameras.txt"),
        ("images.txt", "3 1 0 0 0 1 2 3 1\n\n", "expected IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME"),
        (
            "images.txt",
            "3 1 0 0 0 1 2 3 1 a\n4 1 0 0 0 1 2 3 1 b\n",
            "the next line has 10 words, expected X Y POINT3D_ID",
        ),
        ("images.txt", "3 1 0 0 0 1 2 3 one a\n\n", "expected a whole number, found 'one'"),
        ("images.txt", "# nothing\n\n", "the model has no images"),
    ],
)
def test_bad_text(tmp_path: Path, name: str, text: str, words: str) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE], text=True)
    (tmp_path / name).write_bytes(text.encode("latin-1"))
    with pytest.raises(FormatError, match=words):
        read_colmap(tmp_path)


def test_text_as_people_edit_it(tmp_path: Path) -> None:
    lens = lenses_text([LENS]).replace("\n", "\r\n") + "\r\n\r\n"
    images = images_text([IMAGE, (*IMAGE[:4], "b")], points="").rstrip("\n")
    (tmp_path / "cameras.txt").write_bytes(lens.encode())
    (tmp_path / "images.txt").write_bytes(images.encode())
    assert [camera.name for camera in read_colmap(tmp_path)] == ["left/a.jpg", "b"]


def test_names_without_end_and_damaged_names(tmp_path: Path) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE])
    good = (tmp_path / "images.bin").read_bytes()
    (tmp_path / "images.bin").write_bytes(good.replace(b"left/a.jpg\0", b"n" * 5000 + b"\0"))
    with pytest.raises(FormatError, match="expected a name of at most 4095 bytes"):
        read_colmap(tmp_path)
    (tmp_path / "images.bin").write_bytes(good.replace(b"left/a.jpg", b"left/\xff.jpg"))
    with pytest.raises(FormatError, match="expected text in UTF-8"):
        read_colmap(tmp_path)
    (tmp_path / "images.bin").write_bytes(good.replace(b"left/a.jpg", b""))
    with pytest.raises(FormatError, match="name: expected the photo's file name"):
        read_colmap(tmp_path)


def test_a_real_model(scenes_dir: Path) -> None:
    folder = scenes_dir / "cameras" / "colmap_room"
    if not folder.is_dir():
        pytest.skip(f"no COLMAP model at {folder}")
    read = read_cameras(folder)
    assert [camera.name for camera in read] == sorted(camera.name for camera in read) and len(read) == 3
    for camera in read:
        assert (camera.width, camera.height, camera.cx, camera.cy) == (699, 461, 349.0, 230.0)
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
    # Neighbouring photos of one room: the cameras stand near each other and look the same way.
    assert np.linalg.norm(read[0].center - read[1].center) < 5 and read[0].rotation[2] @ read[1].rotation[2] > 0.5


def test_repeated_images_get_their_place(tmp_path: Path) -> None:
    write_colmap(tmp_path, [LENS], [IMAGE, IMAGE])
    assert [camera.name for camera in read_cameras(tmp_path)] == ["left/a.jpg#0", "left/a.jpg#1"]
