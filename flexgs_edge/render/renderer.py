"""A view of a scene: projection, depth order, tile lists, blending, in depth-ordered batches of a bounded size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera
from flexgs_edge.constants import DEFAULT_NEAR, TILE
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.kernels import Backend
from flexgs_edge.quantize import QuantizedScene
from flexgs_edge.render.device_scene import (
    MIN_CHUNK_ROWS,
    SUM_BYTES,
    DeviceScene,
    QuantizedPlanes,
    SourcePlanes,
    padded,
    plane_bytes,
    upload_bytes,
)
from flexgs_edge.render.records import Statistics, camera_record
from flexgs_edge.scene.source import SceneSource

SORT_DIGIT_BITS = 11
SORT_DIGITS = 1 << SORT_DIGIT_BITS
TARGET_BYTES = 6
"""Bytes a pixel and channel of a target in half precision, and of the residual against it."""
PAIR_BYTES = 20
"""A pair (8) and its draft (12)."""
DEFAULT_PAIRS = 1 << 21
"""Pairs of a batch when memory allows: 40 MiB, one batch for most views."""
PAIR_SHARE = 8
"""The tile lists take at most this part (one in eight) of what is free beyond the least: the scene comes next."""
SUM_ROWS = 1 << 18
"""Rows of sums that are on the host at a time."""
GRADIENT_SUMS = 9
"""Planes of `Renderer.gradient_sums`."""
EXTENTS = ("exact", "inria")


def view_key(scene: DeviceScene, camera: Camera) -> tuple[int, int, int]:
    """What the sizes of a view's buffers depend on."""
    return scene.count, camera.width, camera.height


def view_shapes(backend: Backend, count: int, width: int, height: int) -> dict[str, tuple[tuple[int, ...], Any]]:
    """Shape and type of the buffers of a view, by name; the lists of pairs take what is left."""
    tiles_x, tiles_y = -(-width // TILE), -(-height // TILE)
    return {
        "camera": ((32,), np.float32),
        "records": ((count, 16), np.float32),
        "keys": ((count,), np.uint32),
        "bounds": ((count,), np.uint32),
        "keys_a": ((count,), np.uint32),
        "ids_a": ((count,), np.uint32),
        "keys_b": ((count,), np.uint32),
        "ids_b": ((count,), np.uint32),
        "digits": ((SORT_DIGITS * backend.sort_blocks + 1,), np.uint32),
        "block_pairs": ((backend.sort_blocks,), np.uint64),
        "room": ((2, backend.tile_blocks), np.uint32),
        "ends": ((tiles_x * tiles_y * backend.tile_blocks + 1,), np.uint32),
        "state": ((tiles_x * tiles_y, 4, TILE * TILE), np.float32),
        "image": ((3, tiles_y * TILE, tiles_x * TILE), np.float32),
    }


def shapes_bytes(shapes: dict[str, tuple[tuple[int, ...], Any]]) -> int:
    """Bytes of all of `view_shapes`."""
    return sum(int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


class _ViewBuffers:
    """Buffers that live as long as the views have one size and one number of rows."""

    def __init__(self, backend: Backend, scene: DeviceScene, camera: Camera, budget: MemoryBudget) -> None:
        count, width, height = self.key = view_key(scene, camera)
        self.tiles_x, self.tiles_y = -(-width // TILE), -(-height // TILE)
        self.tiles = self.tiles_x * self.tiles_y
        self.padded_height, self.padded_width = self.tiles_y * TILE, self.tiles_x * TILE
        self.arrays: list[Any] = []
        self._backend = backend
        self._targets: tuple[Any, Any] | None = None
        shapes = view_shapes(backend, count, width, height)
        size = shapes_bytes(shapes)
        # One splat may touch every tile, so no batch can be smaller than that. What the scene and the sums of a scoring pass
        # need at the least is checked with the view, so that one message names a limit that does.
        later = PAIR_BYTES * self.tiles + scene.later_bytes + scene.least_bytes + scene.targets * self._target_bytes
        budget.require(f"a view of {count} Gaussians at {width}x{height}", size + later)
        try:
            made = {name: self._array(shape, dtype) for name, (shape, dtype) in shapes.items()}
            if scene.targets:
                self.target_arrays()
                later -= self._target_bytes
            spare = max(budget.free - later, 0) // (PAIR_SHARE * PAIR_BYTES)
            self.capacity = min(self.tiles + spare, max(DEFAULT_PAIRS, self.tiles))
            self.pairs = self._array((self.capacity, 2), np.uint32)
            self.drafts = self._array((self.capacity, 3), np.uint32)
        except BaseException:
            self.release()
            raise
        self.camera, self.records, self.keys, self.bounds = (made[n] for n in ("camera", "records", "keys", "bounds"))
        self.sorted = [(made["keys_a"], made["ids_a"]), (made["keys_b"], made["ids_b"])]
        self.digits, self.block_pairs = made["digits"], made["block_pairs"]
        self.room, self.ends = made["room"], made["ends"]
        self.state, self.image = made["state"], made["image"]

    @property
    def _target_bytes(self) -> int:
        return TARGET_BYTES * 3 * self.padded_height * self.padded_width

    def _array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        made = self._backend.array(shape, dtype)
        self.arrays.append(made)
        return made

    def target_arrays(self) -> tuple[Any, Any]:
        """A target image in half precision and the residual against it, made when first asked for."""
        if self._targets is None:
            pixels = 3 * self.padded_height * self.padded_width
            self._targets = (self._array((pixels,), np.float16), self._array((pixels,), np.float32))
        return self._targets

    def release(self) -> None:
        for array in self.arrays:
            array.release()
        self.arrays = []
        self._targets = None


@dataclass
class _View:
    """A view whose splats are projected and ordered."""

    buffers: _ViewBuffers
    camera: Camera
    batches: list[tuple[int, int]]


class Renderer:
    """Renders views and sums statistics on a backend.

    Parameters
    ----------
    backend : Backend
        From `flexgs_edge.kernels.open_backend`.
    budget : MemoryBudget
    near : float
        Near plane, scene units.
    background : sequence of float
        Red, green, blue in [0, 1].
    extent : {"exact", "inria"}
        Pixels that a splat may reach: the ellipse of alpha >= 1/255, or the reference rasteriser's tiles of ceil(3 sigma).
    antialiased : bool
        Multiply opacities by sqrt(det before / det after) the dilation of the 2D covariance, as the model was trained.
    """

    def __init__(
        self,
        backend: Backend,
        budget: MemoryBudget,
        near: float = DEFAULT_NEAR,
        background: Sequence[float] = (0.0, 0.0, 0.0),
        extent: str = "exact",
        antialiased: bool = False,
    ) -> None:
        if extent not in EXTENTS:
            raise InputError(f"extent {extent!r}: expected one of {', '.join(EXTENTS)}")
        self.backend = backend
        self.budget = budget
        self.near = near
        self.background = tuple(float(np.float32(c)) for c in background)
        self.inria_extent = int(extent == "inria")
        self.antialiased = antialiased
        self.splats_shown = 0
        self._buffers: _ViewBuffers | None = None

    @property
    def camera_array(self) -> Any:
        """The record of the view drawn last, in the backend's memory."""
        assert self._buffers is not None
        return self._buffers.camera

    @property
    def records_array(self) -> Any:
        """The splats of the view drawn last ([N, 16]), in the backend's memory; rows that it does not show hold anything."""
        assert self._buffers is not None
        return self._buffers.records

    def load(self, source: SceneSource, sum_bytes: int = SUM_BYTES, targets: bool = False) -> DeviceScene:
        """Bring a scene to the backend (all of it, or chunk by chunk for each view when it does not fit).

        `sum_bytes` a row, and room for `targets`, are left free for what is added up over the views.
        """
        self.release()
        planes = SourcePlanes(self.backend, source)
        return DeviceScene(self.backend, planes, self.budget, self.antialiased, sum_bytes, targets)

    def least_bytes(self, source: SceneSource, camera: Camera, sum_bytes: int) -> int:
        """Bytes that a view of `source` with targets and sums of `sum_bytes` a row needs at the least, nothing being loaded."""
        tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
        view = shapes_bytes(view_shapes(self.backend, source.count, camera.width, camera.height))
        chunk = padded(min(MIN_CHUNK_ROWS, source.count)) * (
            plane_bytes(source.sh_degree) + upload_bytes(source.sh_degree)
        )
        pixels = (PAIR_BYTES + TARGET_BYTES * 3 * TILE * TILE) * tiles
        return view + pixels + sum_bytes * source.count + chunk

    def load_quantized(self, quantized: QuantizedScene) -> DeviceScene:
        """Bring a quantized scene to the backend, dequantized there."""
        self.release()
        return DeviceScene(self.backend, QuantizedPlanes(self.backend, quantized), self.budget, self.antialiased)

    def render(self, scene: DeviceScene, camera: Camera) -> np.ndarray:
        """The image of `scene` from `camera` (world coordinates).

        Returns
        -------
        np.ndarray
            [H, W, 3] f32, linear in the model's own colour space, not clamped.
        """
        return self.render_planes(scene, camera)[:, : camera.height, : camera.width].transpose(1, 2, 0)

    def render_planes(self, scene: DeviceScene, camera: Camera) -> np.ndarray:
        """`render` as the kernels leave it: [3, H, W] f32, both sides rounded up to whole tiles."""
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        return self.backend.read(view.buffers.image)

    def drawn_planes(self) -> np.ndarray:
        """The view that was drawn last, for an image or for sums, as `render_planes` would give it."""
        assert self._buffers is not None
        return self.backend.read(self._buffers.image)

    def add_statistics(self, scene: DeviceScene, camera: Camera, statistics: Statistics) -> None:
        """Add one view to `statistics` (hits and weights of every row)."""
        view = self._prepare(scene, camera)
        hits, sums = self._sum_arrays(scene, 1)
        self._blend(view, "blend_stats", (hits, sums, view.buffers.image))
        statistics.hits += self.backend.read(hits)
        statistics.weights += self.read_sums(sums, 1, scene.count)[0].view(np.uint64)

    def removal_sums(self, scene: DeviceScene, camera: Camera) -> Any:
        """Squared error of removing each row alone, and the sum of its squared weights, in one view.

        Returns
        -------
        array of the backend
            [N, 2, 2] u32, low and high words in units of 1 / `FIXED_ERROR`; valid until the next sums.
        """
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        hits, sums = self._sum_arrays(scene, 2)
        self._blend(view, "blend_removal", (hits, sums, view.buffers.image), again=True)
        return sums

    def residual_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray) -> Any:
        """Weights of each row in one view, and what it sees of `target` minus the view.

        Parameters
        ----------
        target : np.ndarray
            [3, H, W] f16, as `render_planes` lays it out.

        Returns
        -------
        array of the backend
            [N, 4, 2] u32, low and high words of sum(alpha T) and sum(alpha T r) for red, green, blue, in units of
            1 / `FIXED_WEIGHT`; valid until the next sums.
        """
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        hits, sums = self._sum_arrays(scene, 4)
        self._blend(view, "blend_residual", (hits, sums, self._residual(view, target)), again=True)
        return sums

    def residual_and_removal_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray) -> Any:
        """Both sums of one view, for less than either alone and a half.

        Returns
        -------
        array of the backend
            [N, 6, 2] u32: the sums of `residual_sums`, then those of `removal_sums`; valid until the next sums.
        """
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        hits, sums = self._sum_arrays(scene, 6)
        residual = self._residual(view, target)
        self._blend(view, "blend_both", (hits, sums, view.buffers.image, residual), again=True)
        return sums

    def gradient_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray) -> Any:
        """What the squared error of one view against `target` changes by when splats change, summed over pixels.

        Of residuals r (target minus view) and the light e that alpha adds when it grows by its own size: sum(alpha T r) for
        red, green, blue, then sum(r e), and its first and second moments about the splat's centre: x, y, xx, xy, yy.

        Returns
        -------
        array of the backend
            [N, 9, 2] u32, low and high words in units of 1 / `FIXED_WEIGHT`, the moments of 1 / `FIXED_MOMENT`; valid until
            the next sums.
        """
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        hits, sums = self._sum_arrays(scene, GRADIENT_SUMS)
        residual = self._residual(view, target)
        self._blend(view, "blend_backward", (hits, sums, view.buffers.image, residual), again=True)
        return sums

    def _residual(self, view: _View, target: np.ndarray) -> Any:
        half, residual = view.buffers.target_arrays()
        self.backend.write(half, target.reshape(-1))
        self.backend.launch("residual", (residual.shape[0],), residual.shape[0], half, view.buffers.image, residual)
        return residual

    def read_sums(self, sums: Any, channels: int, count: int, first: int = 0) -> np.ndarray:
        """[channels, N] i64 from the words of sums, from plane `first` on."""
        values = np.empty((channels, count), np.int64)
        planes = sums.shape[1]
        for base in range(0, count, SUM_ROWS):
            rows = min(SUM_ROWS, count - base)
            words = self.backend.read(sums, np.empty((rows, planes, 2), np.uint32), 2 * planes * base)
            values[:, base : base + rows] = words.view(np.int64)[:, first : first + channels, 0].T
        return values

    def _sum_arrays(self, scene: DeviceScene, channels: int) -> tuple[Any, Any]:
        held = scene.statistics
        if held and held[1].shape[1] != channels:
            for array in held:
                array.release()
            held = scene.statistics = []
        if not held:
            shapes = (((scene.count,), np.uint32), ((scene.count, channels, 2), np.uint32))
            held = scene.statistics = [self.backend.array(shape, dtype) for shape, dtype in shapes]
        for array in held:
            self.backend.fill(array, 0)
        return held[0], held[1]

    def _prepare(self, scene: DeviceScene, camera: Camera) -> _View:
        """Project and order the splats of a view, and split them into batches whose pairs fit."""
        backend = self.backend
        buffers = self._view_buffers(scene, camera)
        backend.write(buffers.camera, camera_record(camera, scene.origin, self.near))
        for chunk in scene.chunks():
            backend.launch(
                "project", (chunk.stride,), chunk.count, chunk.stride, chunk.base, chunk.degree, self.inria_extent,
                int(scene.antialiased), buffers.camera, chunk.means, chunk.cov, chunk.log2_opacity, chunk.sh_dc, chunk.sh_rest,
                buffers.records, buffers.keys, buffers.bounds,
            )  # fmt: skip
        shown, pairs = self._sort(scene.count, buffers)
        self.splats_shown = shown
        batches = [(0, shown)] if pairs <= buffers.capacity else self._batches(buffers, shown)
        return _View(buffers, camera, batches)

    def _blend(self, view: _View, blend: str, extra: tuple[Any, ...] = (), again: bool = False) -> None:
        """Blend all batches; `again`: the lists of a single batch are still there."""
        backend, buffers, camera = self.backend, view.buffers, view.camera
        for index, (start, stop) in enumerate(view.batches):
            if not (again and len(view.batches) == 1):
                self._list_tiles(buffers, camera, start, stop - start)
            backend.launch(
                blend, (buffers.tiles,), buffers.tiles_x, backend.tile_blocks, camera.width, camera.height,
                int(index > 0), int(index == len(view.batches) - 1), *self.background,
                buffers.ends, buffers.pairs, buffers.records, buffers.state, buffers.image, *extra,
            )  # fmt: skip

    def _view_buffers(self, scene: DeviceScene, camera: Camera) -> _ViewBuffers:
        if self._buffers is None or self._buffers.key != view_key(scene, camera):
            self.release()
            try:
                self._buffers = _ViewBuffers(self.backend, scene, camera, self.budget)
            except BudgetError:
                # A larger view than before: the scene gives up its place and is streamed from now on if need be.
                scene.evict()
                self._buffers = _ViewBuffers(self.backend, scene, camera, self.budget)
        return self._buffers

    def _sort(self, count: int, buffers: _ViewBuffers) -> tuple[int, int]:
        """Depth order of the shown splats into `buffers.sorted[0]`; how many there are, and a bound on their pairs."""
        backend, blocks = self.backend, self.backend.sort_blocks
        (keys_a, ids_a), (keys_b, ids_b) = buffers.sorted
        cells = SORT_DIGITS * blocks
        backend.launch(
            "sort_count_first", (blocks,), count, buffers.keys, buffers.bounds, buffers.digits, buffers.block_pairs
        )
        backend.launch("exclusive_scan", (1,), SORT_DIGITS, blocks, buffers.digits)
        backend.launch("sort_scatter_first", (blocks,), count, buffers.keys, buffers.digits, keys_a, ids_a)
        shown = int(backend.read(buffers.digits, np.empty(1, np.uint32), cells)[0])
        pairs = int(backend.read(buffers.block_pairs).sum())
        for shift in (SORT_DIGIT_BITS, 2 * SORT_DIGIT_BITS):
            backend.launch("sort_count", (blocks,), shown, shift, keys_a, buffers.digits)
            backend.launch("exclusive_scan", (1,), SORT_DIGITS, blocks, buffers.digits)
            backend.launch("sort_scatter", (blocks,), shown, shift, keys_a, ids_a, buffers.digits, keys_b, ids_b)
            (keys_a, ids_a), (keys_b, ids_b) = (keys_b, ids_b), (keys_a, ids_a)
        return shown, pairs

    def _batches(self, buffers: _ViewBuffers, shown: int) -> list[tuple[int, int]]:
        """Splits of the depth order whose pairs fit the buffer."""
        order = self.backend.read(buffers.sorted[0][1], np.empty(shown, np.uint32))
        ends = np.cumsum(self.backend.read(buffers.bounds)[order], dtype=np.int64)
        batches, start, done = [], 0, 0
        while start < shown:
            stop = int(np.searchsorted(ends, done + buffers.capacity, side="right"))
            batches.append((start, stop))
            start, done = stop, int(ends[stop - 1])
        return batches

    def _list_tiles(self, buffers: _ViewBuffers, camera: Camera, start: int, count: int) -> None:
        backend, blocks = self.backend, self.backend.tile_blocks
        ids = buffers.sorted[0][1]
        backend.launch("tile_room", (blocks,), start, count, ids, buffers.bounds, buffers.room)
        backend.launch(
            "tile_count", (blocks,), start, count, camera.width, camera.height, self.inria_extent, ids, buffers.records,
            buffers.room, buffers.drafts, buffers.ends,
        )  # fmt: skip
        backend.launch("exclusive_scan", (1,), buffers.tiles, blocks, buffers.ends)
        backend.launch(
            "tile_scatter", (blocks,), buffers.tiles, buffers.room, buffers.drafts, buffers.ends, buffers.pairs
        )

    def release(self) -> None:
        """Free the view's buffers (they come back with the next view)."""
        if self._buffers is not None:
            self._buffers.release()
            self._buffers = None
