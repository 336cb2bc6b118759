"""How much an error counts in each scored pose, by how much error the original has near there itself.

PSNR falls by 10 log10(1 + error / base error). Where the original is near to its photos, a small error costs many decibels;
where it is far away, the same error hides. Equal errors everywhere would break the good views, so errors near these count
more: by a power of 1 / (base error + allowed error), the slope of the drop at the target.

Descents look the more often at a pose, the larger this slope is there.

And a part of the scene that few poses see counts little in their sum, but wholly in a view that looks there. So poses
count more whose picture few others share.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.nearness import squared_distances
from flexgs_edge.cameras.order import in_picture
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.quality.psnr import contrast, far_bases, mse, mse_of_psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource

LEAST = 1e-6
"""Least weight of a pose."""
STEP = 4
"""Every fourth pixel in both directions is compared."""
POWER, RARE_POWER = 4.8, 2.4
"""Powers of the slope, and of how rare a pose's picture is. The slope alone would minimise the mean drop; higher powers lift
the worst view, as a soft maximum does: docs/results/tuning.md#view_weights"""


@dataclass(frozen=True)
class KnownErrors:
    """How near the original is to the photos of the views that decide."""

    cameras: Sequence[Camera]  # the m views
    errors: np.ndarray  # [m] f64, from `base_errors`
    drop: float  # allowed drop, dB

    def slopes(self, cameras: Sequence[Camera]) -> np.ndarray:
        """[n] f64, above 0 to 1: the slope of the drop by the error, of the view that is nearest to each camera.

        `cameras`: the n poses.
        """
        allowed = float(np.median(self.errors)) * (10 ** (self.drop / 10) - 1)
        slopes = 1.0 / (self.errors + max(allowed, 1e-12))
        nearest = squared_distances(cameras, self.cameras).argmin(axis=1)
        relative: np.ndarray = (slopes / slopes.max())[nearest]
        return relative


def base_errors(
    renderer: Renderer,  # with nothing loaded
    source: SceneSource,  # the original
    cameras: Sequence[Camera],  # the views that decide
    photo: Callable[[int, np.ndarray], np.ndarray],
    base_psnr: float = DEFAULT_BASE_PSNR,  # as for `far_bases`
) -> np.ndarray:
    """[n] f64, mean squared error of the original against the photo of each view, or that of `far_bases`.

    `photo`: the photo of a view, [H, W, 3] f32 in [0, 1], by its place in `cameras` and a render of this size.
    """
    errors, contrasts = [], []
    with renderer.load(source) as scene:
        coarse = [camera.every(STEP) for camera in cameras]
        for place, camera in enumerate(renderer.in_turn(scene, coarse)):
            image = np.clip(renderer.render(scene, camera), 0.0, 1.0)
            seen = photo(place, image)
            errors.append(mse(image, seen))
            contrasts.append(contrast(seen))
    renderer.release()
    bases = far_bases(errors, contrasts, base_psnr)
    return np.array([error if base is None else mse_of_psnr(base) for error, base in zip(errors, bases, strict=True)])


def view_weights(slopes: np.ndarray, rare: np.ndarray) -> np.ndarray:
    """How much an error counts in each scored pose, relative to the largest weight.

    `slopes`: [n] f64, from `KnownErrors.slopes`. `rare`: [n] f64, from `rareness`. Returns [n] f64, above 0 to 1.
    """
    weights: np.ndarray = slopes**POWER * rare**RARE_POWER
    relative: np.ndarray = np.maximum(weights / weights.max(), LEAST)
    return relative


def rareness(cameras: Sequence[Camera], points: np.ndarray, near: float) -> np.ndarray:
    """[n] f64, above 0 to 1: mean over the points in each picture of 1 / number of poses that have them in theirs.

    `cameras`: the scored poses. `points`: [3, k] f64, a sample of the scene's positions, world coordinates. `near`:
    near plane, scene units.
    """
    seen = np.array([in_picture(camera, points, near) for camera in cameras])
    share = seen / np.maximum(seen.sum(axis=0), 1)
    found: np.ndarray = share.sum(axis=1) / np.maximum(seen.sum(axis=1), 1)
    # A pose that shows none of the points counts as the least of the others.
    shown = found > 0
    return np.where(shown, found, found[shown].min()) if shown.any() else np.ones(len(cameras))
