"""Where a viewer starts: the view that has most of the scene in its picture, upright."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.up import unit
from flexgs_edge.small_matrices import product

START = "start"  # Name of the view in the settings of a file
PLACE_DIGITS = 9  # Significant digits of places, which may lie far from zero
FARTHEST = 1e15  # Numbers of a file beyond this are no places
SAME_PLACE = 1e-6
"""Cameras stand in one place if they differ by less than this share of its coordinates, which have `PLACE_DIGITS`."""
LEVEL_MOST = 0.99  # Cosine of the direction of view and up. Beyond, the picture's own up is taken.
LEVEL = 0.1
"""Variance of the pictures' horizontal axes along up over that along the next direction: what is more has no common up."""


@dataclass(frozen=True)
class StartView:
    """The view to start from: docs/format.md."""

    eye: tuple[float, ...]  # [3], world coordinates
    target: tuple[float, ...]  # [3], what it looks at
    up: tuple[float, ...]  # [3], of length 1
    fov: tuple[float, ...]  # angles of view, across and down, degrees

    @staticmethod
    def stored(settings: Mapping[str, Any]) -> StartView | None:
        """The view in the settings of a file; None if there is none that makes sense."""
        found = settings.get(START)
        lists = [found.get(name) for name in ("eye", "target", "up", "fov")] if isinstance(found, dict) else [None]
        if not all(isinstance(numbers, list) and all(_is_place(n) for n in numbers) for numbers in lists):
            return None
        eye, target, up, fov = (tuple(float(number) for number in numbers) for numbers in lists if numbers is not None)
        line = np.subtract(target, eye) if len(eye) == len(target) == len(up) == 3 else np.zeros(3)
        seen = len(fov) == 2 and all(0 < angle < 180 for angle in fov)
        return StartView(eye, target, up, fov) if seen and np.abs(np.cross(line, up)).max() > 0 else None

    def to_json(self) -> dict[str, Any]:
        """What `stored` reads."""
        return {"eye": [*self.eye], "target": [*self.target], "up": [*self.up], "fov": [*self.fov]}

    def is_of(self, cameras: Sequence[Camera]) -> bool:
        """Whether one of the cameras stands here, as one of those does that the view was chosen from."""
        room = SAME_PLACE * (1 + max(abs(value) for value in self.eye))
        return any(float(np.abs(camera.center - self.eye).max()) <= room for camera in cameras)

    def camera(self, width: int, height: int) -> Camera:
        """A camera whose picture, of this size, shows at least what the view does."""
        eye, angles = np.array(self.eye), [math.radians(angle) for angle in self.fov]
        forward = unit(np.array(self.target) - eye)
        right = unit(np.cross(forward, self.up))
        rotation = np.stack([right, np.cross(forward, right), forward])
        f = min(size / 2 / math.tan(angle / 2) for size, angle in zip((width, height), angles, strict=True))
        return Camera(START, width, height, rotation, -product(rotation, eye), f, f, (width - 1) / 2, (height - 1) / 2)


def start_view(cameras: Sequence[Camera], positions: np.ndarray, best: int | None = None) -> StartView:
    """The view to start from.

    `cameras`: at least one. `positions`: [3, n] f64, world coordinates of some of the Gaussians, n >= 1. `best`: choose among
    so many of the first cameras. Default: all. Of views that show equally many, the first is taken.
    """
    depths = [_depths_shown(camera, positions) for camera in cameras[:best]]
    chosen = max(range(len(depths)), key=lambda view: depths[view].size)
    camera, shown = cameras[chosen], depths[chosen]
    distance = float(np.median(shown)) if shown.size else 1.0
    forward = camera.rotation[2]
    up = _up_of(cameras)
    if abs(float((up * forward).sum())) > LEVEL_MOST:
        up = -camera.rotation[1]
    sizes = camera.width / camera.fx, camera.height / camera.fy
    return StartView(
        tuple(_place(value) for value in camera.center.tolist()),
        tuple(_place(value) for value in (camera.center + distance * forward).tolist()),
        tuple(round(value, 4) for value in up.tolist()),
        tuple(round(math.degrees(2 * math.atan(size / 2)), 2) for size in sizes),
    )


def _up_of(cameras: Sequence[Camera]) -> np.ndarray:
    """[3] f64, up: level pictures have horizontal axes at right angles to it. Without such a direction, the mean of their ups."""
    mean = -np.sum([camera.rotation[1] for camera in cameras], axis=0)
    across = np.array([camera.rotation[0] for camera in cameras])
    # No product whose sum depends on the processor: files keep the result.
    (least, middle, _), axes = np.linalg.eigh((across[:, :, None] * across[:, None, :]).sum(axis=0))
    if least < LEVEL * middle:
        return np.asarray(axes[:, 0] * (1.0 if float((axes[:, 0] * mean).sum()) > 0 else -1.0))
    return unit(mean) if np.abs(mean).max() > 1e-6 else -cameras[0].rotation[1]


def _depths_shown(camera: Camera, positions: np.ndarray) -> np.ndarray:
    """[k] f64, depths of those positions that lie in the camera's picture."""
    x, y, z = product(camera.rotation, positions) + camera.translation[:, None]
    z = np.where(z > 0, z, np.nan)
    column, row = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    inside = (np.abs(column - (camera.width - 1) / 2) <= camera.width / 2) & (
        np.abs(row - (camera.height - 1) / 2) <= camera.height / 2
    )
    return z[inside]


def _is_place(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) < FARTHEST


def _place(value: float) -> float:
    return float(f"{value:.{PLACE_DIGITS}g}")
