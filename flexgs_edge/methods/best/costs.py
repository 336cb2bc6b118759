"""Measured costs: the squared error of removing a Gaussian, and of dropping its SH to each lower degree.

One pass over the scored poses gives both. Each cost is that of one change alone, with all other splats as they are.
Errors of Gaussians that were removed together show only in the next pass.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from functools import partial
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import FIXED_ERROR, FIXED_WEIGHT, SUM_LANES
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.chunks import Chunk, ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import padded
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import planes_of
from flexgs_edge.scene.source import Planes
from flexgs_edge.views.sums import Maker, ViewSums


@dataclass
class RemovalCosts:
    """Squared errors summed over pixels, three channels and the scored poses."""

    # [N] f64, cost of removing the Gaussian. It is exact if the hits of all other splats stay the same.
    removal: np.ndarray
    weight2: np.ndarray  # [N] f64, sum of squared weights (alpha T)^2; 0 for Gaussians that no pose sees
    # [D, N] f64, cost of keeping SH only up to degree L = 0 .. D-1, with `sh_mean[L]` added to the colour.
    sh: np.ndarray
    sh_mean: np.ndarray  # [D, 3, N] f32, mean colour over poses (weighted by weight2) of the bands above L

    @classmethod
    def of(cls, parts: Sequence[CostParts], storage: Storage = IN_MEMORY) -> RemovalCosts:
        """Costs over all poses, from sums that each cover a part of the poses."""
        levels, count = parts[0].moments.shape[0], len(parts[0].removal)
        costs = cls.empty(levels, count, storage)
        for rows, found in read_ahead(
            count, *(getattr(part, array.name) for array in fields(CostParts) for part in parts)
        ):
            removal, weight2, moments = (
                np.asarray(sum(found[at : at + len(parts)])) for at in range(0, len(found), len(parts))
            )
            divisor = np.where(weight2 > 0, weight2, 1.0)
            # A variance of zero may come out slightly negative by rounding.
            variance = np.maximum(moments[:, 3] - (moments[:, :3] ** 2).sum(axis=1) / divisor, 0.0)
            # Colours of some thousands in every view saturate a sum, which must not look like no variance at all.
            put_rows(costs.removal, rows, removal)
            put_rows(costs.weight2, rows, weight2)
            put_rows(costs.sh, rows, np.where(moments[:, 3] >= 2.0**63 / FIXED_WEIGHT, moments[:, 3], variance))
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

    `removal`, `weight2`: [N] f64, as in `RemovalCosts`.
    """

    removal: np.ndarray
    weight2: np.ndarray
    # [D, 4, N] f64, sums over the colour of the bands above each degree: three of squared weight times colour, one of
    # squared weight times squared colour.
    moments: np.ndarray

    def take(self, rows: np.ndarray, storage: Storage = IN_MEMORY) -> CostParts:
        """The sums of some rows."""
        return CostParts(*(storage.take(values, rows) for values in (self.removal, self.weight2, self.moments)))


def snapshot_bytes(sh_degree: int) -> int:
    """Bytes a row of `RemovalCosts`."""
    removal, weight2, cost, mean = 8, 8, 8, 12
    return removal + weight2 + (cost + mean) * sh_degree


def cost_bytes(sh_degree: int) -> int:
    """Bytes a row that `cost_sums` take on the backend."""
    return 32 * (1 + sh_degree)


def cost_sums(renderer: Renderer, degree: int, first: int = 0) -> Maker:
    """Maker of the sums over views from which costs are computed.

    `degree`: SH degree of the scene, or 0 to leave the costs of dropping SH degrees out. `first`: plane of a view's
    sums at which the removal sums begin.
    """
    return partial(_ChunkCosts, renderer, degree, first)


def cost_parts(levels: int, count: int, storage: Storage) -> CostParts:
    """Empty sums for `count` rows of SH degree `levels`, to be filled by `put_costs`."""
    one, two = (storage.empty((count,), np.float64) for _ in range(2))
    return CostParts(one, two, storage.empty((levels, 4, count), np.float64))


def put_costs(parts: CostParts, rows: slice, sums: Any) -> None:
    """Put the finished sums of a chunk (from `cost_sums`) into their rows."""
    for part, values in sums.values():
        some = slice(rows.start + part.start, rows.start + part.stop)
        wide = values[:4].view(np.uint64)
        for own, low, high in ((parts.removal, wide[0], wide[1]), (parts.weight2, wide[2], wide[3])):
            put_rows(own, some, (high * 2.0**64 + low) / FIXED_ERROR)
        moments = values[4:].reshape(-1, 4, values.shape[1]) / FIXED_WEIGHT
        put_rows(parts.moments, some, moments if len(moments) else np.zeros((len(parts.moments), *moments.shape[1:])))


def measure_costs(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[Camera],
    sh_costs: bool = True,  # Measure the costs of dropping SH degrees too (default). Otherwise their arrays are empty.
    progress: Progress = SILENT,
) -> RemovalCosts:
    """Costs over all poses from one pass; see `measure_parts`."""
    degree = scene.sh_degree if sh_costs else 0
    return RemovalCosts.of([measure_parts(renderer, scene, cameras, degree, progress)], renderer.storage)


def measure_parts(
    renderer: Renderer,  # draws the views
    scene: DeviceScene,  # loaded with room for the sums of this pass
    cameras: Sequence[Camera],  # the scored poses, or a part of them
    degree: int,  # as for `cost_sums`
    progress: Progress = SILENT,  # told of each view
    drawn: Callable[[int, np.ndarray], None] | None = None,  # takes the place of each view and its picture
) -> CostParts:
    """Measure costs in one pass, which takes about twice the time of rendering the poses."""
    costs = ViewSums(renderer, scene, [cost_sums(renderer, degree)])
    try:
        views = progress.track(costs.draw("removal_sums", cameras), "measuring costs", len(cameras))
        for place, picture in enumerate(views):
            if drawn is not None:
                drawn(place, picture())
        found = cost_parts(degree, scene.count, renderer.storage)
        for rows, (sums,) in costs.parts():
            put_costs(found, rows, sums)
        return found
    finally:
        costs.release()


class _ChunkCosts:
    """Sums of one chunk, on the backend: squared errors, squared weights, and weighted moments of the colour."""

    def __init__(self, renderer: Renderer, degree: int, first: int, chunk: Chunk) -> None:
        self._renderer, self._first, self._count = renderer, first, chunk.count
        self._degree = min(degree, chunk.degree)
        self._array = renderer.backend.array((-(-chunk.stride // SUM_LANES), 4 + 4 * self._degree, SUM_LANES), np.int64)
        renderer.backend.fill(self._array, 0)

    def add(self, chunk: Chunk, sums: Any, part: ViewPart) -> None:
        self._renderer.backend.launch(
            "add_costs", (padded(part.count),), part.count, chunk.stride, part.base, part.first, self._degree,
            sums.shape[1], self._first, part.blocks, self._renderer.camera_array, chunk.means, chunk.sh_rest, sums,
            self._array,
        )  # fmt: skip

    def values(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield rows of the chunk and their sums ([4 + 4 degree, rows] i64), valid until the next step."""
        return planes_of(self._renderer.backend, self._array, self._count)

    def release(self) -> None:
        if self._array is not None:
            self._array.release()
            self._array = None


class Snapshot:
    """The Gaussians that are kept after a round, with refitted colours and measured costs.

    `rows`: [n] i64, places in the rows that the rounds began with (`PruneRounds.rows`), ascending. `planes`: stored
    planes of these rows ([width, n] f32 by field). `costs`: costs of these rows.
    """

    def __init__(self, rows: np.ndarray, planes: Planes, costs: RemovalCosts) -> None:
        self.rows, self.costs = rows, costs
        self._planes: Planes | None = planes
        self._again: Callable[[], Planes] | None = None

    @property
    def count(self) -> int:
        """Gaussians kept."""
        return len(self.rows)

    @property
    def planes(self) -> Planes:
        """Stored planes of the rows. If they were let go, they are made again."""
        if self._planes is None:
            assert self._again is not None
            self._planes = self._again()
        return self._planes

    @property
    def held(self) -> bool:
        """Whether the planes need not be made again."""
        return self._planes is not None

    def let_go(self, again: Callable[[], Planes]) -> None:
        """Free the planes; `again` makes them once more if somebody asks for them."""
        self._planes, self._again = None, again

    def cheapest(self, count: int) -> np.ndarray:
        """[n] bool: False for the `count` rows that are cheapest to remove. Rows that no pose sees stay; ties go by row."""
        seen = self.costs.weight2 > 0
        return ~lowest(np.where(seen, self.costs.removal, np.inf), min(count, int(np.count_nonzero(seen))))


def lowest(values: np.ndarray, count: int) -> np.ndarray:
    """[n] bool: True for the `count` smallest of `values` (all, if there are no more). Of equal values the first ones count."""
    if count >= len(values):
        return np.ones(len(values), bool)
    if count <= 0:
        return np.zeros(len(values), bool)
    edge = np.partition(values, count - 1)[count - 1]
    chosen: np.ndarray = values < edge
    chosen[np.flatnonzero(values == edge)[: count - int(np.count_nonzero(chosen))]] = True
    return chosen
