"""Lens distortion: OpenCV's polynomial and its fisheye, and photos without it."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

_BLOCK = 64  # Rows that are resampled at a time
_EDGE = 65  # Places along each edge, and along each ray, where `fitted` looks
_ZOOMS = np.arange(1.0, 2.0, 0.002)


@dataclass(frozen=True)
class Lens:
    """A lens, and the zoom of the pinhole camera that takes its place.

    Source: https://docs.opencv.org/4.x/d9/d0c/group__calib3d.html and its module fisheye.
    """

    radial: tuple[float, ...]  # OpenCV's k1 to k6 (the last three divide), or the fisheye's k1 to k4
    tangential: tuple[float, float] = (0.0, 0.0)  # p1 and p2; not for a fisheye
    fisheye: bool = False  # the radial polynomial is of the angle to the axis
    zoom: float = 1.0  # focal length of the pinhole over that of the lens

    def bent(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Where the lens shows points of the plane at distance 1, in the same units (all arrays f64 of one shape)."""
        k = (*self.radial, *(0.0,) * (6 - len(self.radial)))
        square = x * x + y * y
        if self.fisheye:
            radius = np.sqrt(square)
            angle = np.arctan(radius)
            t = angle * angle
            factor = angle * (1 + t * (k[0] + t * (k[1] + t * (k[2] + t * k[3])))) / np.maximum(radius, 1e-12)
            factor = np.where(radius < 1e-12, 1.0, factor)
            return x * factor, y * factor
        factor = 1 + square * (k[0] + square * (k[1] + square * k[2]))
        factor = factor / (1 + square * (k[3] + square * (k[4] + square * k[5])))
        p1, p2 = self.tangential
        return (
            x * factor + 2 * p1 * x * y + p2 * (square + 2 * x * x),
            y * factor + p1 * (square + 2 * y * y) + 2 * p2 * x * y,
        )


@lru_cache(maxsize=64)
def fitting_zoom(lens: Lens, width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> float | None:
    """The least zoom from 1 on at which every pixel of the pinhole lies in the photo; None if there is none up to 2.

    A ray of the lens must also lead outwards all along: polynomials fold back beyond the angles they were fitted to.
    """
    across, down = np.linspace(0, width - 1, _EDGE), np.linspace(0, height - 1, _EDGE)
    left, right, top, bottom = (
        np.zeros(_EDGE),
        np.full(_EDGE, width - 1.0),
        np.zeros(_EDGE),
        np.full(_EDGE, height - 1.0),
    )
    x = (np.concatenate([across, across, left, right]) - cx) / fx
    y = (np.concatenate([top, bottom, down, down]) - cy) / fy
    ray = np.linspace(0, 1, _EDGE)[:, None]
    for zoom in _ZOOMS:
        with np.errstate(all="ignore"):
            u, v = lens.bent(ray * x / zoom, ray * y / zoom)
            outwards = np.all(np.diff(np.hypot(u, v), axis=0) > 0)
            u, v = fx * u[-1] + cx, fy * v[-1] + cy
        if outwards and min(u.min(), v.min()) >= -0.5 and u.max() <= width - 0.5 and v.max() <= height - 0.5:
            return float(zoom)
    return None


def straightened(pixels: np.ndarray, lens: Lens, fx: float, fy: float, cx: float, cy: float) -> np.ndarray:
    """A photo as the pinhole camera (fx, fy, cx, cy: pixels) would have taken it: bilinear, [H, W, 3] f32."""
    height, width = pixels.shape[:2]
    result = np.empty_like(pixels)
    for start in range(0, height, _BLOCK):
        rows = np.arange(start, min(start + _BLOCK, height))
        x, y = np.meshgrid((np.arange(width) - cx) / fx, (rows - cy) / fy)
        u, v = lens.bent(x, y)
        u, v = (u * (fx / lens.zoom) + cx).clip(0, width - 1), (v * (fy / lens.zoom) + cy).clip(0, height - 1)
        left, top = np.minimum(u.astype(int), max(width - 2, 0)), np.minimum(v.astype(int), max(height - 2, 0))
        right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
        a, b = ((u - left)[:, :, None].astype(np.float32), (v - top)[:, :, None].astype(np.float32))
        upper = pixels[top, left] * (1 - a) + pixels[top, right] * a
        lower = pixels[bottom, left] * (1 - a) + pixels[bottom, right] * a
        result[rows] = upper * (1 - b) + lower * b
    return result
