"""The camera itself, splits, limits, and reading a file of cameras by path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from flexgs_edge.cameras.camera import Camera, limit_width, split_views
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from synthetic import look_from, make_camera

SAMPLE = Path(__file__).parents[2] / "samples" / "still_life"


def project(camera: Camera, point: np.ndarray) -> np.ndarray:
    x, y, z = camera.rotation @ point + camera.translation
    return np.array([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])


def turned(seed: int = 1) -> Camera:
    rotation, translation = look_from(seed)
    return make_camera(64, 48, rotation=rotation, translation=translation, centre=(30.0, 20.5))


def test_arrays_are_float64_copies_that_cannot_be_written() -> None:
    rotation = np.eye(3, dtype=np.float32)
    camera = make_camera(rotation=rotation)
    rotation[0, 0] = 9.0
    assert camera.rotation.dtype == camera.translation.dtype == np.float64
    assert camera.rotation[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        camera.rotation[0, 0] = 2.0


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match=r"camera 'view': rotation: expected shape \(3, 3\), found \(4, 4\)"):
        make_camera(rotation=np.eye(4))


def test_the_center_is_where_camera_space_is_zero() -> None:
    camera = turned()
    np.testing.assert_allclose(camera.rotation @ camera.center + camera.translation, 0.0, atol=1e-14)


@pytest.mark.parametrize("size", [(64, 48), (32, 24), (33, 48), (1, 1), (128, 7)])
def test_scaling_keeps_the_edges_of_the_image(size: tuple[int, int]) -> None:
    camera = turned()
    small = camera.scaled(*size)
    point = np.array([0.3, -0.2, 4.0])
    across = (project(camera, point) + 0.5) / [camera.width, camera.height]
    np.testing.assert_allclose((project(small, point) + 0.5) / size, across, rtol=1e-12)
    assert (small.width, small.height, small.name) == (*size, camera.name)


def test_scaling_keeps_a_centred_principal_point_centred() -> None:
    small = make_camera(100, 50).scaled(25, 10)
    assert (small.cx, small.cy) == ((25 - 1) / 2, (10 - 1) / 2)


def test_scaling_to_nothing_is_refused() -> None:
    with pytest.raises(InputError, match="size 0x5"):
        turned().scaled(0, 5)


def test_moving_the_origin_changes_no_pixel() -> None:
    camera, origin = turned(), np.array([4e5, -3e5, 7.0])
    far = camera.moved(-origin)  # the same view of a scene that stands at `origin`
    point = np.array([0.3, -0.2, 4.0])
    np.testing.assert_allclose(project(far, point + origin), project(camera, point), atol=1e-6)
    np.testing.assert_allclose(far.moved(origin).translation, camera.translation, atol=1e-9)


@given(st.integers(0, 100), st.integers(0, 12).filter(lambda n: n != 1))
def test_splits_cover_every_view_once(count: int, holdout: int) -> None:
    train, held = split_views(count, holdout)
    assert sorted(train + held) == list(range(count))
    assert held == ([i for i in range(count) if i % holdout == 0] if holdout else [])


def test_the_default_split_is_every_eighth() -> None:
    assert split_views(50)[1] == [0, 8, 16, 24, 32, 40, 48]


@pytest.mark.parametrize("holdout", [-1, 1])
def test_splits_that_make_no_sense(holdout: int) -> None:
    with pytest.raises(InputError, match=f"--holdout {holdout}: expected 0 .* or 2"):
        split_views(10, holdout)


def test_every_pixel_of_a_lattice_is_one_of_the_whole_view() -> None:
    camera, point = turned(), np.array([0.3, -0.2, 4.0])
    for step, column, row in ((1, 0, 0), (2, 1, 0), (3, 2, 1), (2.5, 1.25, 0.75)):
        part = camera.every(step, column, row)
        np.testing.assert_allclose(project(part, point) * step + (column, row), project(camera, point), rtol=1e-12)
        columns, rows = np.arange(column, 63.5, step), np.arange(row, 47.5, step)
        assert (part.width, part.height) == (np.count_nonzero(columns <= 63), np.count_nonzero(rows <= 47))
        # A quarter of a pixel's area of the lattice is a pixel's of the whole.
        assert part.dilation * step**2 == pytest.approx(camera.dilation)


@pytest.mark.parametrize("place", [(2, 2, 0), (2, 0, -1), (100, 70, 0)])
def test_lattices_without_pixels_are_refused(place: tuple[int, int, int]) -> None:
    with pytest.raises(InputError, match=r"no such pixels in 64x48"):
        turned().every(*place)


def test_only_wide_views_are_limited() -> None:
    cameras = [make_camera(1600, 900), make_camera(4946, 3286), make_camera(3, 9)]
    limited, note = limit_width(cameras, 1600)
    assert [(c.width, c.height) for c in limited] == [(1600, 900), (1600, 1063), (3, 9)]
    assert limited[0] is cameras[0]
    assert note == "1 view scaled down to 1600 pixels wide"
    assert limit_width(cameras[:1], 1600) == (cameras[:1], None)


def test_a_limit_never_leaves_an_empty_view() -> None:
    limited, _ = limit_width([make_camera(1000, 2)], 10)
    assert (limited[0].width, limited[0].height) == (10, 1)
    with pytest.raises(InputError, match="--resolution 0"):
        limit_width([make_camera()], 0)


def test_the_sample_by_file_and_by_folder() -> None:
    cameras = read_cameras(SAMPLE / "cameras.json")
    assert [c.name for c in cameras] == [f"view_{i:02d}" for i in range(80)]
    assert [c.name for c in read_cameras(str(SAMPLE))] == [c.name for c in cameras]
    # All look at the table near the world's origin: it lies in front of every camera, inside the image.
    for camera in cameras:
        pixel = project(camera, np.zeros(3))
        assert (camera.rotation @ np.zeros(3) + camera.translation)[2] > 0
        assert (pixel > -0.25 * camera.width).all() and (pixel < 1.25 * camera.width).all()


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("none.json", "no such camera file; supported: INRIA"),
        ("cameras.xml", "unknown kind of camera file; supported: INRIA"),
        ("half", "expected cameras and images, both .bin or both .txt; found cameras.bin only"),
        ("half/cameras.bin", "found cameras.bin only"),
        (
            "empty",
            "no cameras.json, transforms.json, transforms_train.json or COLMAP model in this folder; supported: INRIA",
        ),
    ],
)
def test_paths_that_are_no_cameras(tmp_path: Path, name: str, words: str) -> None:
    for folder in ("half", "empty"):
        (tmp_path / folder).mkdir()
    for file in ("half/cameras.bin", "cameras.xml"):
        (tmp_path / file).touch()
    with pytest.raises(InputError, match=words):
        read_cameras(tmp_path / name)


def test_rotations_of_six_digits_far_from_the_origin() -> None:
    """By the transpose, the place was off by a unit 10^6 units away, and poses were scored in another order."""
    rotation = np.round(look_from(3)[0], 6)
    place = np.array([1e6, -2e6, 3e5])
    camera = make_camera(rotation=rotation, translation=tuple(-rotation @ place))
    assert np.abs(rotation.T @ rotation - np.eye(3)).max() > 1e-8
    np.testing.assert_allclose(camera.center, place, rtol=1e-13)
    # Written and read again it still looks at the same things.
    np.testing.assert_allclose(-rotation @ camera.center, camera.translation, rtol=1e-13)
    near = [
        make_camera(rotation=np.round(look_from(i)[0], 6), translation=look_from(i)[1], name=str(i)) for i in range(12)
    ]
    far = [replace(camera, translation=camera.translation - camera.rotation @ place) for camera in near]
    np.testing.assert_allclose([c.center - place for c in far], [c.center for c in near], atol=1e-8)
