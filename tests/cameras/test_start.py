"""The view that a viewer starts from."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.start import START, StartView, start_view

GOOD: dict[str, Any] = {"eye": [5e5, 2, 3], "target": [5e5 + 3, 4, 9], "up": [0, -0.6, 0.8], "fov": [60, 40]}


def around(heights: tuple[float, ...], roll: float = 0.0) -> list[Camera]:
    """Level cameras around z, up to a roll, at these heights; they look at the origin."""
    cameras = []
    for k, height in enumerate(heights):
        eye = np.array([3 * np.cos(2.4 * k), 3 * np.sin(2.4 * k), height])
        forward = -eye / np.linalg.norm(eye)
        right = np.cross(forward, [0, 0, 1.0])
        right /= np.linalg.norm(right)
        right = np.cos(roll) * right + np.sin(roll) * np.cross(forward, right)
        rotation = np.stack([right, np.cross(forward, right), forward])
        cameras.append(Camera(f"{k}", 100, 80, rotation, -rotation @ eye, 90.0, 90.0, 49.5, 39.5))
    return cameras


def test_the_view_that_shows_most_is_upright() -> None:
    positions = np.random.default_rng(1).uniform(-3, 3, (3, 500))
    cameras = around((4.0, 3.0, 8.0, 2.0, 5.0))  # all look down, so the mean of their ups is not up
    start = start_view(cameras, positions)
    assert start.is_of(cameras[2:3]) and not start.is_of(cameras[:2])  # the farthest one
    assert start.up == (0.0, 0.0, 1.0) and start.fov == (58.11, 47.92)
    assert np.allclose(start.target, 0, atol=1)
    near = start_view(cameras, positions, best=2)
    assert near.is_of(cameras[:1]) and near.up == start.up
    camera = start.camera(200, 80)
    assert np.allclose(camera.rotation, cameras[2].rotation, atol=1e-3) and np.allclose(camera.center, start.eye)
    assert (camera.width, camera.height, camera.cx, round(camera.fx, 1), camera.fx) == (200, 80, 99.5, 90.0, camera.fy)


def test_without_a_common_up() -> None:
    positions = np.zeros((3, 1))
    (one,) = around((3.0,))
    assert np.allclose(start_view([one], positions).up, -one.rotation[1], atol=1e-4)
    down = Camera("down", 100, 80, np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0, 3]), 90.0, 90.0, 49.5, 39.5)
    start = start_view([down, *around((0.0, 0.1, -0.1))], positions, best=1)  # it looks along the up of the others
    assert np.allclose(start.up, [0, 1, 0])
    rolled = [*around((2.0,), 0.0), *around((2.0,), 2.0), *around((2.0,), 4.0)]
    assert np.isclose(np.linalg.norm(start_view(rolled, positions).up), 1, atol=1e-3)


def test_what_sees_nothing_is_a_view_too() -> None:
    cameras = around((0.0, 1.0))
    start = start_view(cameras, np.array([[1e6], [0.0], [0.0]]))
    assert start.is_of(cameras[:1]) and np.isclose(np.linalg.norm(np.subtract(start.target, start.eye)), 1)


def test_settings_keep_it() -> None:
    start = StartView.stored({START: GOOD})
    assert start is not None and StartView.stored({START: start.to_json()}) == start
    assert StartView.stored({}) is None


@pytest.mark.parametrize(
    ("name", "value"),
    [("eye", [1, 2]), ("eye", None), ("target", "abc"), ("target", [5e5, 2, 3]), ("up", [0, True, 0]), ("up", [3, 2, 6]),
     ("fov", [60, 180]), ("fov", [60]), ("fov", [0, 40]), ("eye", [10**400, 0, 0])],
)  # fmt: skip
def test_settings_that_are_no_view(name: str, value: Any) -> None:
    assert StartView.stored({START: {**GOOD, name: value}}) is None


@pytest.mark.parametrize("value", [None, 3, [1, 2], {}])
def test_values_that_are_no_view(value: Any) -> None:
    assert StartView.stored({START: value}) is None
