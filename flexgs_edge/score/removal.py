"""Measured costs: the squared error of removing a Gaussian, and of dropping its SH to each lower degree.

One pass over the training poses gives both. The costs are those of one change alone, all other splats staying as they are;
what was removed together is measured by the next pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.constants import FIXED_ERROR, FIXED_WEIGHT
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render import DeviceScene, Renderer


@dataclass
class RemovalCosts:
    """Squared errors summed over pixels, three channels and the scored poses.

    Attributes
    ----------
    removal : np.ndarray
        [N] f64, of removing the Gaussian (kernels.md: exact with the other splats' hits frozen).
    weight2 : np.ndarray
        [N] f64, sum of squared weights (alpha T)^2; 0 for Gaussians that no pose sees.
    sh : np.ndarray
        [D, N] f64, of keeping SH up to degree L = 0 .. D-1 only, with `sh_mean[L]` added to the colour.
    sh_mean : np.ndarray
        [D, 3, N] f32, mean colour over poses (weighted by weight2) of the bands above L.
    """

    removal: np.ndarray
    weight2: np.ndarray
    sh: np.ndarray
    sh_mean: np.ndarray

    def take(self, rows: np.ndarray) -> RemovalCosts:
        """The costs of some rows."""
        return RemovalCosts(self.removal[rows], self.weight2[rows], self.sh[:, rows], self.sh_mean[:, :, rows])


class _Wide:
    """Sums of 64-bit fixed-point values beyond 64 bits: adding is exact, so any order gives the same bits."""

    def __init__(self, count: int) -> None:
        self.low = np.zeros(count, np.uint64)
        self.high = np.zeros(count, np.uint32)

    def add(self, values: np.ndarray) -> None:
        self.low += values.view(np.uint64)
        self.high += self.low < values.view(np.uint64)

    def value(self, unit: float) -> np.ndarray:
        return (self.high * 2.0**64 + self.low) / unit


class CostSums:
    """Sums over views of what costs are made of.

    Parameters
    ----------
    renderer, scene : Renderer, DeviceScene
    sh_costs : bool
        Measure the costs of dropping SH degrees as well (empty arrays otherwise).
    """

    def __init__(self, renderer: Renderer, scene: DeviceScene, sh_costs: bool = True) -> None:
        self._renderer, self._count = renderer, scene.count
        self._removal, self._weight2 = _Wide(scene.count), _Wide(scene.count)
        self._moments = _Moments(renderer, scene, scene.sh_degree if sh_costs else 0)

    def add_view(self, sums: Any, first: int = 0) -> None:
        """Add the view drawn last; its removal sums begin at plane `first` of `sums`."""
        self._moments.add_view(sums, first + 1)
        errors, weights = self._renderer.read_sums(sums, 2, self._count, first)
        self._removal.add(errors)
        self._weight2.add(weights)

    def finish(self) -> RemovalCosts:
        """The costs over the views added."""
        weight = self._weight2.value(FIXED_ERROR)
        sh, sh_mean = self._moments.finish(weight)
        return RemovalCosts(self._removal.value(FIXED_ERROR), weight, sh, sh_mean)

    def release(self) -> None:
        """Free what is held on the backend."""
        self._moments.release()


def measure_costs(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[Camera],
    sh_costs: bool = True,
    progress: Progress = SILENT,
) -> RemovalCosts:
    """One scoring pass: about twice the cost of rendering the poses.

    Parameters
    ----------
    renderer, scene : Renderer, DeviceScene
    cameras : sequence of Camera
        The scored poses.
    sh_costs : bool
        As for `CostSums`.
    """
    costs = CostSums(renderer, scene, sh_costs)
    try:
        for camera in progress.track(cameras, "measuring costs", len(cameras)):
            costs.add_view(renderer.removal_sums(scene, camera))
        return costs.finish()
    finally:
        costs.release()


class _Moments:
    """Weighted moments of the colour above each SH degree, chunk by chunk, on the backend."""

    def __init__(self, renderer: Renderer, scene: DeviceScene, degree: int) -> None:
        self.renderer, self.scene, self.degree = renderer, scene, degree
        self.arrays: dict[int, tuple[int, Any]] = {}

    def add_view(self, sums: Any, plane: int) -> None:
        if not self.degree:
            return
        backend, camera = self.renderer.backend, self.renderer.camera_array
        for chunk in self.scene.chunks():
            if not chunk.degree:
                continue
            if chunk.base not in self.arrays:
                array = backend.array((self.degree, 4, chunk.stride), np.int64)
                backend.fill(array, 0)
                self.arrays[chunk.base] = (chunk.count, array)
            backend.launch(
                "sh_costs", (chunk.stride,), chunk.count, chunk.stride, chunk.base, chunk.degree, sums.shape[2],
                plane, camera, chunk.means, chunk.sh_rest, sums, self.arrays[chunk.base][1],
            )  # fmt: skip

    def finish(self, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Costs ([D, N]) and mean colours ([D, 3, N]) from the moments and the sum of weights ([N])."""
        count = self.scene.count
        costs, means = np.zeros((self.degree, count)), np.zeros((self.degree, 3, count), np.float32)
        for base, (chunk_count, array) in self.arrays.items():
            rows = slice(base, base + chunk_count)
            moments = self.renderer.backend.read(array)[:, :, :chunk_count] / FIXED_WEIGHT
            divisor = np.where(weight[rows] > 0, weight[rows], 1.0)
            # Rounding may leave a variance of nothing slightly below zero.
            costs[:, rows] = np.maximum(moments[:, 3] - (moments[:, :3] ** 2).sum(axis=1) / divisor, 0.0)
            means[:, :, rows] = moments[:, :3] / divisor
        return costs, means

    def release(self) -> None:
        for _, array in self.arrays.values():
            array.release()
        self.arrays = {}
