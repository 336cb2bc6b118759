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

MOMENT_FULL = 2.0**63 / FIXED_WEIGHT
"""Where the sums of moments stop (colours of some thousands in every view)."""


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

    @classmethod
    def of(cls, parts: Sequence[CostParts]) -> RemovalCosts:
        """Costs over all poses, from sums over some of them each."""
        removal, weight2 = sum(part.removal for part in parts), sum(part.weight2 for part in parts)
        moments = sum(part.moments for part in parts)
        assert isinstance(removal, np.ndarray) and isinstance(weight2, np.ndarray) and isinstance(moments, np.ndarray)
        divisor = np.where(weight2 > 0, weight2, 1.0)
        # Rounding may leave a variance of nothing slightly below zero.
        variance = np.maximum(moments[:, 3] - (moments[:, :3] ** 2).sum(axis=1) / divisor, 0.0)
        # A sum that stopped growing must not look like no variance at all.
        sh = np.where(moments[:, 3] >= MOMENT_FULL, moments[:, 3], variance)
        return cls(removal, weight2, sh, (moments[:, :3] / divisor).astype(np.float32))


@dataclass
class CostParts:
    """Sums over some poses that costs are made of; sums over others add up with them.

    Attributes
    ----------
    removal, weight2 : np.ndarray
        [N] f64, as in `RemovalCosts`.
    moments : np.ndarray
        [D, 4, N] f64: of the colour of the bands above each degree, times the squared weight (three channels), and of its square.
    """

    removal: np.ndarray
    weight2: np.ndarray
    moments: np.ndarray

    def take(self, rows: np.ndarray) -> CostParts:
        """The sums of some rows."""
        return CostParts(self.removal[rows], self.weight2[rows], self.moments[:, :, rows])


def moment_bytes(sh_degree: int) -> int:
    """Bytes a row that the moments of `CostSums` take on the backend."""
    return 32 * sh_degree


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

    def finish(self) -> CostParts:
        """The sums over the views added."""
        return CostParts(self._removal.value(FIXED_ERROR), self._weight2.value(FIXED_ERROR), self._moments.finish())

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
        return RemovalCosts.of([costs.finish()])
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
                "sh_costs", (chunk.stride,), chunk.count, chunk.stride, chunk.base, chunk.degree, sums.shape[1],
                plane, camera, chunk.means, chunk.sh_rest, sums, self.arrays[chunk.base][1],
            )  # fmt: skip

    def finish(self) -> np.ndarray:
        """[D, 4, N] f64."""
        moments = np.zeros((self.degree, 4, self.scene.count))
        for base, (count, array) in self.arrays.items():
            moments[:, :, base : base + count] = self.renderer.backend.read(array)[:, :, :count] / FIXED_WEIGHT
        return moments

    def release(self) -> None:
        for _, array in self.arrays.values():
            array.release()
        self.arrays = {}
