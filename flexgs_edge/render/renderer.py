"""Draw one view of a scene: project, sort by depth, list tiles and blend.

Long lists are split into depth-ordered batches.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import DEFAULT_NEAR, DILATION, ROW_SPAN, TILE
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import Backend, window
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.packed.quantize import QuantizedScene
from flexgs_edge.render import fit as fit_module
from flexgs_edge.render.ahead import ViewsAhead, camera_record
from flexgs_edge.render.chunks import QuantizedPlanes, SourcePlanes, ViewPart
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import GRADIENT_SUMS, GROWTH, GUESS, MOST_SUMS, SUM_BYTES, Fit, fits_whole, saves_bytes
from flexgs_edge.render.statistics import Statistics, SumReader
from flexgs_edge.render.view_buffers import ViewBuffers, list_tiles, sort_splats, split_batches, view_size
from flexgs_edge.scene.source import SceneSource


@dataclass
class _View:
    """A view whose splats are projected and sorted by depth."""

    buffers: ViewBuffers
    camera: Camera
    batches: list[tuple[int, int]]
    count: int  # Rows of the view's sums
    parts: dict[int, ViewPart] | None  # The rows of each chunk, by the chunk's first row; None in a compact view


class Renderer(AbstractContextManager["Renderer"]):
    """Renders views and sums what each Gaussian contributes, on a backend.

    `antialiased`: multiply opacities by sqrt(det before / det after) of the 2D covariance's dilation. Set it if the model was
    trained so. `storage`: takes the sums over views if memory cannot hold them beside a view. `largest`: the largest view to
    come, if it is known. Its size decides whether views have room for all rows.
    """

    def __init__(
        self,
        backend: Backend,  # from `flexgs_edge.kernels.backend`
        budget: MemoryBudget,
        near: float = DEFAULT_NEAR,  # near plane, scene units
        background: Sequence[float] = (0.0, 0.0, 0.0),  # red, green, blue in [0, 1]; black by default
        antialiased: bool = False,
        fit: Fit | None = None,  # how scenes and views share memory
    ) -> None:
        self.backend = backend
        self.budget = budget
        self.near = near
        self.background = tuple(float(np.float32(c)) for c in background)
        self.antialiased = antialiased
        self.fit = fit or fit_module.DEFAULT
        self.storage: Storage = IN_MEMORY
        self.largest: Camera | None = None
        self.splats_shown = 0
        self._shown_rows: np.ndarray | None = None
        """[m] u32, the rows of the scene that the last view shows, if it was compact."""
        self._share = 0.0  # Largest share of its rows that a scene has shown in a compact view so far
        self._ahead = ViewsAhead(backend, self.fit.ahead)
        self._buffers: ViewBuffers | None = None
        self._drawn: _View | None = None
        self._aimed: Any = None
        self._scene_rows = 0
        self._reader = SumReader(backend)

    def aim(self, camera: Camera, origin: np.ndarray) -> None:
        """Write a camera's record into `camera_array` without drawing."""
        self.backend.write(self.camera_array, camera_record(camera, origin, self.near))

    @property
    def camera_array(self) -> Any:
        """The camera record of the last drawn or aimed view, on the backend."""
        if self._buffers is not None:
            return self._buffers.camera
        if self._aimed is None:  # a view drawn elsewhere allocates no buffers here
            self._aimed = self.backend.array((32,), np.float32)
        return self._aimed

    @property
    def parts(self) -> dict[int, ViewPart] | None:
        """Where the last view has the rows of each chunk, by the chunk's first row; None if it was compact."""
        assert self._drawn is not None
        return self._drawn.parts

    @property
    def view_rows(self) -> np.ndarray | None:
        """[m] u32, the rows of the scene that the last view's sums belong to; None if they are all rows."""
        if self._drawn is None or self._drawn.parts is None:
            return self._shown_rows
        parts = self._drawn.parts.values()
        if self._drawn.count == self._scene_rows:
            return None
        return np.concatenate([part.rows for part in parts])

    @property
    def records_array(self) -> Any:
        """[N, 16], the splat records of the last `gradient_sums`, on the backend; rows not shown are undefined."""
        assert self._buffers is not None
        return self._buffers.records

    def load(
        self,
        source: SceneSource,
        sum_bytes: int = SUM_BYTES,  # bytes a row to leave free for sums over views
        references: bool = False,  # leave room to compare views with targets
        structure: bool = False,  # leave room for the structural term of `gradient_sums`
        view_sums: int = MOST_SUMS,  # most planes of sums that a view has
    ) -> DeviceScene:
        """Bring a scene to the backend: all of it, or chunk by chunk for each view if it does not fit."""
        self.release()
        planes = SourcePlanes(self.backend, source)
        return DeviceScene(
            self.backend, planes, self.budget, self.antialiased, sum_bytes, references, structure, view_sums, self.fit
        )

    def load_quantized(self, quantized: QuantizedScene) -> DeviceScene:
        """Bring a quantized scene to the backend, where each chunk is dequantized."""
        self.release()
        planes = QuantizedPlanes(self.backend, quantized)
        return DeviceScene(self.backend, planes, self.budget, self.antialiased, fit=self.fit)

    def render(self, scene: DeviceScene, camera: Camera) -> np.ndarray:
        """Draw `scene` from `camera` (world coordinates).

        Returns [H, W, 3] f32 in the model's own colour space, not clamped.
        """
        return self.render_planes(scene, camera)[:, : camera.height, : camera.width].transpose(1, 2, 0)

    def in_turn(self, scene: DeviceScene, cameras: Sequence[Camera]) -> Iterator[Camera]:
        """Yield each camera when its view is to be drawn. A scene in scratch files is then read once for several views."""
        return self._ahead.in_turn(scene, cameras)

    def render_planes(self, scene: DeviceScene, camera: Camera) -> np.ndarray:
        """Draw a view, in the layout of the kernels: [3, H, W] f32, both sides rounded up to whole tiles."""
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        return view.buffers.picture()

    def drawn_planes(self) -> np.ndarray:
        """The last drawn view, also if it was drawn for sums, in the layout of `render_planes`."""
        assert self._buffers is not None
        return self._buffers.picture()

    def drawn_coverage(self) -> float:
        """Share of the last drawn view that its splats cover: the mean over its pixels of 1 - transmittance, in [0, 1].

        It has the same bits for all forms of a scene (whole, in chunks, compact) and for the twins.
        """
        assert self._drawn is not None
        self._blend(self._drawn, "blend", again=True, finish=False)
        return self._drawn.buffers.coverage()

    def add_statistics(self, scene: DeviceScene, camera: Camera, statistics: Statistics) -> None:
        """Add the hits and weights of every row in one view to `statistics`."""
        hits, weights, rows = self._statistics(scene, camera)
        statistics.hits[rows] += self.backend.read(hits, np.empty(weights.size, np.uint32))
        statistics.weights[rows] += weights

    def shown_weights(self, scene: DeviceScene, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """The rows that contribute to a view ([m] i64, ascending), and their weights in it ([m] u64), as in `Statistics`."""
        _, weights, rows = self._statistics(scene, camera)
        some = np.flatnonzero(weights)
        return some if isinstance(rows, slice) else rows[some].astype(np.int64), weights[some]

    def _statistics(self, scene: DeviceScene, camera: Camera) -> tuple[Any, np.ndarray, Any]:
        """Hits in a view on the backend, weights there, and the rows that they belong to."""
        view = self._prepare(scene, camera)
        hits, sums = self._sum_arrays(scene, view, 1)
        self._blend(view, "blend_stats", (hits, sums))
        found = self.view_rows
        return hits, self._reader.first_plane(sums, view.count), slice(None) if found is None else found

    def removal_sums(self, scene: DeviceScene, camera: Camera) -> Any:
        """Squared error of removing each row alone, and the sum of its squared weights, in one view.

        Returns [m, 2, 2] u32 for the rows of `parts` or `view_rows`, low and high words in units of 1 / `FIXED_ERROR`;
        valid until the next sums are drawn.
        """
        return self._sums(scene, camera, 2, "blend_removal")

    def residual_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray) -> Any:
        """Weights of each row in one view, and the weighted residual (`target` minus the view) at its pixels.

        `target`: [3, H, W] f16, in the layout of `render_planes`.

        Returns [m, 4, 2] u32, low and high words of sum(alpha T) and sum(alpha T r) for red, green, blue, in units of 1
        / `FIXED_WEIGHT`; valid until the next sums are drawn.
        """
        return self._sums(scene, camera, 4, "blend_residual", target)

    def residual_and_removal_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray) -> Any:
        """The sums of `residual_sums` and `removal_sums` in one view, cheaper than two calls.

        Returns [m, 6, 2] u32: the sums of `residual_sums`, then those of `removal_sums`; valid until the next sums are drawn.
        """
        return self._sums(scene, camera, 6, "blend_both", target)

    def gradient_sums(self, scene: DeviceScene, camera: Camera, target: np.ndarray, structure: float = 0.0) -> Any:
        """Gradients of the loss of one view against `target`, for each splat, summed over pixels.

        The loss is the squared error, plus `structure` times 1 - SSIM (`add_structure`). Let r be
        minus half of its gradient by the view: target minus view, without structure. Let e be the light that a splat
        adds when its alpha grows by its own size. The sums are sum(alpha T r) for red, green, blue, then sum(r e), then
        its moments about the splat's centre: x, y, xx, xy, yy.

        Returns [N, 9, 2] u32 for all rows, low and high words in units of 1 / `FIXED_WEIGHT`, the moments in units of 1
        / `FIXED_MOMENT`; valid until the next sums are drawn.
        """
        # A descent moves means and scales, so the bounds of the blocks say nothing here.
        view = self._prepare(scene, camera, whole=True)
        self._blend(view, "blend")
        hits, sums = self._sum_arrays(scene, view, GRADIENT_SUMS)
        residual = target_residual(self.backend, view.buffers, target)
        if structure:
            add_structure(self.backend, view.buffers, camera, structure)
        self._blend(view, "blend_backward", (hits, sums, residual), again=True)
        return sums

    def _sums(
        self, scene: DeviceScene, camera: Camera, channels: int, blend: str, target: np.ndarray | None = None
    ) -> Any:
        """Draw a view, then its sums by `blend`, against a target if there is one."""
        view = self._prepare(scene, camera)
        self._blend(view, "blend")
        extra = self._sum_arrays(scene, view, channels)
        residual = () if target is None else (target_residual(self.backend, view.buffers, target),)
        self._blend(view, blend, (*extra, *residual), again=True)
        return extra[1]

    def _sum_arrays(self, scene: DeviceScene, view: _View, channels: int) -> tuple[Any, Any]:
        held, count = scene.statistics, view.buffers.rows or scene.count
        if held and held[1].shape[:2] != (count, channels):
            scene.drop_statistics()
            held = []
        if not held:
            # Only the blend of weights counts hits; the other blends leave this array alone.
            shapes = (((count if channels == 1 else 1,), np.uint32), ((count, channels, 2), np.uint32))
            held = scene.statistics = [self.backend.array(shape, dtype) for shape, dtype in shapes]
        for array in held if channels == 1 else held[1:]:
            self.backend.fill(array, 0, min(view.count, array.shape[0]))
        return held[0], held[1]

    def _prepare(self, scene: DeviceScene, camera: Camera, whole: bool = False) -> _View:
        """Project the splats of a view, sort them by depth, and split them into batches whose pairs fit.

        With `whole`, no block is left out.
        """
        buffers = self._view_buffers(scene, camera)
        parts, self._shown_rows, self._scene_rows = None, None, scene.count
        if buffers.rows is not None:
            buffers, self._shown_rows = self._project_compact(scene, camera, buffers)
            count = len(self._shown_rows)
        else:
            parts = self._project(scene, camera, buffers, whole)
            count = sum(part.count for part in parts.values())
        shown, pairs = sort_splats(self.backend, buffers, count)
        self.splats_shown = shown
        batches = [(0, shown)] if pairs <= buffers.capacity else split_batches(self.backend, buffers, shown)
        self._drawn = _View(buffers, camera, batches, count, parts)
        return self._drawn

    def _project(self, scene: DeviceScene, camera: Camera, buffers: ViewBuffers, whole: bool) -> dict[int, ViewPart]:
        """Project the blocks that the view may show, or all with `whole`, one after the other without gaps."""
        record = camera_record(camera, scene.origin, self.near)
        self.backend.write(buffers.camera, record)
        blocks, parts = buffers.blocks(scene.blocks), {}
        base = first = 0
        for chunk in scene.chunks():
            seen = scene.blocks_seen(chunk, None if whole else record)
            part = parts[chunk.base] = ViewPart.of(chunk, seen, base, first, blocks)
            base, first = base + part.count, first + len(seen)
            if part.count:
                self.backend.write(blocks, seen, part.first)
                chunk.project(
                    self.backend, buffers.camera, part, scene.antialiased,
                    (buffers.records, buffers.keys, buffers.bounds),
                )  # fmt: skip
        return parts

    def _project_compact(
        self, scene: DeviceScene, camera: Camera, buffers: ViewBuffers
    ) -> tuple[ViewBuffers, np.ndarray]:
        """Project and keep only the splats that the view shows, in row order, so that the image has the same bits.

        If the view shows more splats than its buffers hold, they are allocated anew. Their size comes from the count,
        or from an estimate by the part of the scene that was projected.
        """
        while True:
            count, seen, rows = self._ahead.fill(scene, camera, buffers, self.storage, self.near)
            if rows is not None:
                self._share = max(self._share, count / max(scene.count, 1))
                return buffers, rows
            assert buffers.rows is not None
            scene.shown = self.fit.capacity(scene.count, GROWTH * max(count / max(seen, 1), buffers.rows / scene.count))
            scene.drop_statistics()
            self.release()
            self._buffers = buffers = ViewBuffers(self.backend, scene, camera, self.budget, scene.shown)

    def _blend(
        self, view: _View, blend: str, extra: tuple[Any, ...] = (), again: bool = False, finish: bool = True
    ) -> None:
        """Blend all batches. With `again`, a single batch reuses the tile lists that are still there.

        Without `finish`, the image stays as it is, and colour and transmittance are left in the view's `state`.
        """
        backend, buffers, camera = self.backend, view.buffers, view.camera
        for index, (start, stop) in enumerate(view.batches):
            if not (again and len(view.batches) == 1):
                list_tiles(backend, buffers, camera, start, stop - start)
            backend.launch(
                blend, (buffers.size.tiles,), buffers.size.tiles_x, backend.tile_blocks, camera.width, camera.height,
                int(index > 0), int(finish and index == len(view.batches) - 1), *self.background,
                buffers.ends, buffers.pairs, buffers.records, buffers.state, buffers.image, *extra,
            )  # fmt: skip

    def _view_buffers(self, scene: DeviceScene, camera: Camera) -> ViewBuffers:
        if self._buffers is None or not self._buffers.serve(scene, camera):
            self.release()
            shown = self.fit.capacity(scene.count, max(1 / self.fit.first_share, GUESS * self._share))
            if scene.shown is None and self._may_be_compact(scene, camera, shown) and not self.fits(scene, camera):
                scene.be_compact(shown)
            try:
                self._buffers = ViewBuffers(self.backend, scene, camera, self.budget, scene.shown)
            except BudgetError:
                if scene.shown is not None:
                    scene.shown = self.fit.capacity(scene.count, 1 / self.fit.first_share)
                # The view needs memory: free this scene and all others, which are streamed from now on if need be.
                for evict in (scene.evict, *self.budget.evictors):
                    evict()
                self._buffers = ViewBuffers(self.backend, scene, camera, self.budget, scene.shown)
            scene.choose_rows_anew()
        return self._buffers

    def _may_be_compact(self, scene: DeviceScene, camera: Camera, shown: int) -> bool:
        """Whether sums over compact views of `shown` rows have a place. Sums that exist already stay where they are."""
        if scene.statistics or self.storage.spills:
            return not scene.statistics
        return saves_bytes(scene, view_size(self.backend, camera), shown)

    def fits(self, scene: DeviceScene, camera: Camera) -> bool:
        """Whether all rows of the scene fit into this view, or into the largest one to come."""
        if self.largest is not None and self.largest.width * self.largest.height > camera.width * camera.height:
            camera = self.largest
        size = view_size(self.backend, camera)
        return self.fit.whole_views and fits_whole(scene, size, self.budget.free, self.storage.spills)

    def release(self) -> None:
        """Free the view's buffers; the next view allocates them again."""
        self._reader.release()
        if self._buffers is not None:
            self._buffers.release()
            self._buffers = self._drawn = None
        if self._aimed is not None:
            self._aimed.release()
            self._aimed = None

    def close(self) -> None:
        """Free the view's buffers, and close the backend."""
        self.release()
        self.backend.close()

    def __exit__(self, *exc: object) -> None:
        self.close()


def target_residual(backend: Backend, buffers: ViewBuffers, target: np.ndarray) -> Any:
    """What the drawn view lacks of `target` ([3, H, W] f16, laid out as by `Renderer.render_planes`).

    The result is an array of the backend, [3 H W] f32 and more: `target` - view.
    The target must not change afterwards, since the device may read it later.
    """
    half, residual = buffers.reference_arrays()
    backend.write(half, target.reshape(-1), stays=True)
    backend.launch("residual", (target.size,), target.size, half, buffers.image, residual)
    return residual


def add_structure(backend: Backend, buffers: ViewBuffers, camera: Camera, weight: float) -> None:
    """Add minus half the gradient of `weight` times the sum of 1 - SSIM, over windows and channels, to the residual.

    SSIM is that of the drawn view and its target, both clamped to [0, 1], by windows inside the picture. The windows of
    a sampled view (`Camera.every`) cover as much of the picture as those of a whole view. A view with a side below the
    window's has no term.
    """
    weights = window(round(math.sqrt(DILATION / camera.dilation)))
    size = len(weights)
    if min(camera.width, camera.height) < size:
        return
    taps, slopes = buffers.structure_arrays(weights)
    target, residual = buffers.reference_arrays()
    stride, plane = buffers.size.tiles_x * TILE, buffers.size.pixels
    across, wide = -(-stride // ROW_SPAN) * ROW_SPAN, buffers.size.slopes // 9
    windows, columns = (side - size + 1 for side in (camera.height, camera.width))
    backend.launch(
        "dssim_slopes", (3 * windows * across,), across, windows, columns, stride, plane, wide, size, taps, buffers.image,
        target, slopes,
    )  # fmt: skip
    backend.launch(
        "dssim_residual", (3 * camera.height * across,), across, camera.height, stride, plane, wide, weight / 2, size, taps,
        slopes, buffers.image, target, residual,
    )  # fmt: skip
