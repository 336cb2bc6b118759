"""Measured costs: the squared error of removing a Gaussian, and of dropping its SH to each lower degree.

One pass over the scored poses gives both. Each cost is that of one change alone, with all other splats as they are.
Errors of Gaussians that were removed together show only in the next pass.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR, FIXED_WEIGHT
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.chunks import Chunk
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.views.bench import Bench
from flexgs_edge.views.sums import Maker, ViewSums

MOMENT_FULL = 2.0**63 / FIXED_WEIGHT
"""Sums of moments saturate here. Only colours of some thousands in every view reach it."""


@dataclass
class RemovalCosts:
    """Squared errors summed over pixels, three channels and the scored poses.

    Attributes
    ----------
    removal : np.ndarray
        [N] f64, cost of removing the Gaussian. It is exact if the hits of all other splats stay the same.
    weight2 : np.ndarray
        [N] f64, sum of squared weights (alpha T)^2; 0 for Gaussians that no pose sees.
    sh : np.ndarray
        [D, N] f64, cost of keeping SH only up to degree L = 0 .. D-1, with `sh_mean[L]` added to the colour.
    sh_mean : np.ndarray
        [D, 3, N] f32, mean colour over poses (weighted by weight2) of the bands above L.
    """

    removal: np.ndarray
    weight2: np.ndarray
    sh: np.ndarray
    sh_mean: np.ndarray

    @classmethod
    def of(cls, parts: Sequence[CostParts], storage: Storage = IN_MEMORY) -> RemovalCosts:
        """Costs over all poses, from sums that each cover a part of the poses."""
        levels, count = parts[0].moments.shape[0], len(parts[0].removal)
        costs = cls.empty(levels, count, storage)
        for rows, found in read_ahead(count, *(getattr(part, name) for name in PART_NAMES for part in parts)):
            removal, weight2, moments = (
                np.asarray(sum(found[at : at + len(parts)])) for at in range(0, len(found), len(parts))
            )
            divisor = np.where(weight2 > 0, weight2, 1.0)
            # A variance of zero may come out slightly negative by rounding.
            variance = np.maximum(moments[:, 3] - (moments[:, :3] ** 2).sum(axis=1) / divisor, 0.0)
            # A saturated sum must not look like no variance at all.
            put_rows(costs.removal, rows, removal)
            put_rows(costs.weight2, rows, weight2)
            put_rows(costs.sh, rows, np.where(moments[:, 3] >= MOMENT_FULL, moments[:, 3], variance))
            put_rows(costs.sh_mean, rows, (moments[:, :3] / divisor).astype(np.float32))
        return costs

    @classmethod
    def empty(cls, levels: int, count: int, storage: Storage = IN_MEMORY) -> RemovalCosts:
        """Arrays for `count` rows of SH degree `levels`."""
        one, two = (storage.empty((count,), np.float64) for _ in range(2))
        return cls(one, two, storage.empty((levels, count), np.float64), storage.empty((levels, 3, count), np.float32))


@dataclass
class CostParts:
    """Sums over a part of the poses, from which costs are computed; sums over other parts can be added.

    Attributes
    ----------
    removal, weight2 : np.ndarray
        [N] f64, as in `RemovalCosts`.
    moments : np.ndarray
        [D, 4, N] f64, sums over the colour of the bands above each degree: three of squared weight times colour, one of
        squared weight times squared colour.
    """

    removal: np.ndarray
    weight2: np.ndarray
    moments: np.ndarray

    def take(self, rows: np.ndarray, storage: Storage = IN_MEMORY) -> CostParts:
        """The sums of some rows."""
        return CostParts(*(storage.take(values, rows) for values in (self.removal, self.weight2, self.moments)))


def moment_bytes(sh_degree: int) -> int:
    """Bytes a row that the moments of `cost_sums` take on the backend."""
    return 32 * sh_degree


PART_NAMES = ("removal", "weight2", "moments")
"""Arrays of `CostParts`."""


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


def cost_sums(renderer: Renderer, degree: int, first: int = 0) -> Maker:
    """Maker of the sums over views from which costs are computed.

    Parameters
    ----------
    degree : int
        SH degree of the scene, or 0 to leave the costs of dropping SH degrees out.
    first : int
        Plane of a view's sums at which the removal sums begin.
    """
    return partial(_ChunkCosts, renderer, degree, first)


def cost_parts(levels: int, count: int, storage: Storage) -> CostParts:
    """Empty sums for `count` rows of SH degree `levels`, to be filled by `put_costs`."""
    one, two = (storage.empty((count,), np.float64) for _ in range(2))
    return CostParts(one, two, storage.empty((levels, 4, count), np.float64))


def put_costs(parts: CostParts, rows: slice, sums: Any) -> None:
    """Put the finished sums of a chunk (from `cost_sums`) into their rows."""
    put_rows(parts.removal, rows, sums.removal.value(FIXED_ERROR))
    put_rows(parts.weight2, rows, sums.weight2.value(FIXED_ERROR))
    put_rows(parts.moments, rows, sums.moments())


def measure_costs(
    bench: Bench,
    scene: DeviceScene,
    cameras: Sequence[Camera],
    sh_costs: bool = True,
    progress: Progress = SILENT,
) -> RemovalCosts:
    """Measure costs in one pass, which takes about twice the time of rendering the poses.

    Parameters
    ----------
    bench : Bench
        Draws the views.
    scene : DeviceScene
        Loaded with room for the sums of this pass.
    cameras : sequence of Camera
        The scored poses.
    sh_costs : bool
        Measure the costs of dropping SH degrees too (default). Otherwise their arrays are empty.
    progress : Progress
        Told of each view.
    """
    degree = scene.sh_degree if sh_costs else 0
    costs = ViewSums(bench, scene, [cost_sums(bench.renderer, degree)])
    try:
        for _ in progress.track(costs.draw("removal_sums", cameras), "measuring costs", len(cameras)):
            pass
        found = cost_parts(degree, scene.count, bench.renderer.storage)
        for rows, (sums,) in costs.parts():
            put_costs(found, rows, sums)
        return RemovalCosts.of([found], bench.renderer.storage)
    finally:
        costs.release()


class _ChunkCosts:
    """Sums of one chunk: squared errors and weights on the host, weighted moments of the colour on the backend."""

    def __init__(self, renderer: Renderer, degree: int, first: int, chunk: Chunk) -> None:
        self._renderer, self._degree, self._first, self._count = renderer, degree, first, chunk.count
        self.removal, self.weight2 = _Wide(chunk.count), _Wide(chunk.count)
        self._moments: Any = None
        if degree and chunk.degree:
            self._moments = renderer.backend.array((degree, 4, chunk.stride), np.int64)
            renderer.backend.fill(self._moments, 0)

    def add(self, chunk: Chunk, sums: Any, base: int) -> None:
        renderer = self._renderer
        if self._moments is not None:
            renderer.backend.launch(
                "sh_costs", (chunk.stride,), chunk.count, chunk.stride, base, chunk.degree, sums.shape[1],
                self._first + 1, renderer.camera_array, chunk.means, chunk.sh_rest, sums, self._moments,
            )  # fmt: skip
        errors, weights = renderer.read_sums(sums, 2, chunk.count, self._first, base)
        self.removal.add(errors)
        self.weight2.add(weights)

    def moments(self) -> np.ndarray:
        """[D, 4, n] f64."""
        if self._moments is None:
            return np.zeros((self._degree, 4, self._count))
        moments: np.ndarray = self._renderer.backend.read(self._moments)[:, :, : self._count] / FIXED_WEIGHT
        return moments

    def release(self) -> None:
        if self._moments is not None:
            self._moments.release()
            self._moments = None
