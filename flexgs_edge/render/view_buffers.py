"""The buffers of a view on a backend, within the memory budget, and what fills them: splats by depth, and tile by tile."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render import fit
from flexgs_edge.render.device_scene import DeviceScene

TILES_AT_ONCE = 1024  # Tiles whose state is copied to the host at a time
PIECES = 8  # A batch has at least so many pieces, so that at most one part in so many of its room stays empty
MOST_COUNTED = 2**32 - 1  # Most pairs that the device counts in one block


def view_size(backend: Backend, camera: Camera) -> fit.ViewSize:
    """The size of a view's buffers, apart from their rows."""
    return fit.ViewSize(camera.width, camera.height, backend.sort_blocks, backend.tile_blocks)


class ViewBuffers:
    """Buffers for views of one number of rows, and of at most so many tiles; arrays of a smaller view use their first elements.

    With `rows`, they are the buffers of a compact view: room for that many splats, and for one projected chunk.
    """

    def __init__(
        self, backend: Backend, scene: DeviceScene, camera: Camera, budget: MemoryBudget, rows: int | None = None
    ) -> None:
        self.rows = rows
        count = scene.count if rows is None else rows
        self._scene_rows = scene.count
        self.size = self._largest = view_size(backend, camera)
        self.arrays: list[Any] = []
        self._backend = backend
        self._references: tuple[Any, Any] | None = None
        self._structure: tuple[Any, Any] | None = None
        self._window = 0  # Side of the window that the taps and the zeros around the slopes are for; 0: none yet
        shapes = fit.view_shapes(self.size, count)
        size = fit.shapes_bytes(shapes)
        # A splat may touch every tile, so a batch must have room for one pair a tile. The least that the scene and the
        # sums need is checked here too, so that one error message names a limit that is large enough.
        later = fit.target_bytes(scene, self.size)
        later += fit.PAIR_BYTES * self.size.tiles + scene.later_bytes + scene.least_bytes
        what = f"a view of {count} Gaussians"
        if rows is not None:
            what = f"a view that shows {count} of {scene.count} Gaussians"
            shapes |= fit.chunk_shapes(scene.compact_rows)
            later += scene.shown_bytes * rows - scene.later_bytes
            size = fit.shapes_bytes(shapes)
        budget.require(f"{what} at {camera.width}x{camera.height}", size + later)
        try:
            made = {name: self._array(shape, dtype) for name, (shape, dtype) in shapes.items()}
            if scene.references:
                self.reference_arrays()
            if scene.structure:
                self.structure_room()
            later -= fit.target_bytes(scene, self.size)
            pairs = min(scene.fit.pairs, backend.most_pairs or scene.fit.pairs)
            share, most = fit.PAIR_SHARE, max(pairs, self.size.tiles)
            if rows is not None:
                share = fit.COMPACT_PAIR_SHARE
                # Chunks that stay use what the tile lists leave. Buffers for views that show more rows need their room.
                scene.give_way(later + share * most * fit.PAIR_BYTES - budget.free)
            spare = max(budget.free - later, 0) // (share * fit.PAIR_BYTES)
            self.capacity = min(self.size.tiles + spare, most)
            self.pairs = self._array((self.capacity, 2), np.uint32)
            self.drafts = self._array((self.capacity, 3), np.uint32)
        except BaseException:
            self.release()
            raise
        self.camera, self.records, self.keys, self.bounds = (made[n] for n in ("camera", "records", "keys", "bounds"))
        self._blocks: Any = made["blocks"]
        self.sorted = [(made["keys_a"], made["ids_a"]), (made["keys_b"], made["ids_b"])]
        self.digits, self.block_pairs = made["digits"], made["block_pairs"]
        self.pair_room, self.ends = made["pair_room"], made["ends"]
        self.state, self.image = made["state"], made["image"]
        self.chunk = tuple(made[name] for name in fit.chunk_shapes(0)) if rows is not None else ()

    def _array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        made = self._backend.array(shape, dtype)
        self.arrays.append(made)
        return made

    def serve(self, scene: DeviceScene, camera: Camera) -> bool:
        """Take the size of a view; False if they have no room for it."""
        size, most = view_size(self._backend, camera), self._largest
        if scene.count != self._scene_rows or size.tiles > most.tiles or size.slopes > most.slopes:
            return False
        if size != self.size:
            self.size, self._window = size, 0
        return True

    def picture(self) -> np.ndarray:
        """[3, H, W] f32, the drawn view; both sides are rounded up to whole tiles."""
        shape = fit.view_shapes(self.size, 0)["image"][0]
        return self._backend.read(self.image, np.empty(shape, np.float32))

    def coverage(self) -> float:
        """Mean over the view's pixels of 1 - transmittance, from `state` after the last batch.

        A pixel that has ended keeps its transmittance with the sign flipped. Those outside the picture have -1.
        """
        covered = 0.0
        for first in range(0, self.size.tiles, TILES_AT_ONCE):
            part = np.empty((min(TILES_AT_ONCE, self.size.tiles - first), *self.state.shape[1:]), np.float32)
            self._backend.read(self.state, part, first * part[0].size)
            covered += float(np.sum(1.0 - np.abs(part[:, 3]).astype(np.float64)))
        return covered / (self.size.width * self.size.height)

    def blocks(self, count: int) -> Any:
        """An array for the numbers of `count` blocks ([.] u32); kept until more are asked for."""
        if self._blocks.shape[0] < count:
            self.arrays.remove(self._blocks)
            self._blocks.release()
            self._blocks = self._array((count,), np.uint32)
        return self._blocks

    def reference_arrays(self) -> tuple[Any, Any]:
        """The target image (f16) and the residual against it (f32), allocated at the first call."""
        if self._references is None:
            pixels = 3 * self._largest.pixels
            self._references = (self._array((pixels,), np.float16), self._array((pixels,), np.float32))
        return self._references

    def structure_arrays(self, weights: np.ndarray) -> tuple[Any, Any]:
        """Taps of a window, with these weights, and slopes, for the gradient of SSIM; allocated at the first call.

        The kernels rely on zeros around the slopes that they write, which are others for each size of the window.
        """
        taps, slopes = self._structure or self.structure_room()
        if len(weights) != self._window:
            self._backend.write(taps, weights)
            self._backend.fill(slopes, 0, self.size.slopes)
            self._window = len(weights)
        return taps, slopes

    def structure_room(self) -> tuple[Any, Any]:
        """Allocate the arrays for the gradient of SSIM."""
        taps, slopes = (self._array(shape, dtype) for shape, dtype in fit.structure_shapes(self._largest).values())
        self._structure = taps, slopes
        return taps, slopes

    def release(self) -> None:
        """Free all buffers."""
        for array in self.arrays:
            array.release()
        self.arrays = []
        self._references, self._structure, self._window = None, None, 0


def sort_splats(backend: Backend, buffers: ViewBuffers, count: int) -> tuple[int, int]:
    """Sort the shown ones of `count` splats by depth into `buffers.sorted[0]`; return their number and a bound on their pairs."""
    blocks = backend.sort_blocks
    (keys_a, ids_a), (keys_b, ids_b) = buffers.sorted
    cells = fit.SORT_DIGITS * blocks
    backend.launch(
        "sort_count_first", (blocks,), count, buffers.keys, buffers.bounds, buffers.digits, buffers.block_pairs
    )
    backend.launch("exclusive_scan", (1,), fit.SORT_DIGITS, blocks, buffers.digits)
    backend.launch("sort_scatter_first", (blocks,), count, buffers.keys, buffers.digits, keys_a, ids_a)
    total = backend.read(buffers.digits, np.empty(1, np.uint32), cells, waits=False)
    pairs = int(backend.read(buffers.block_pairs).sum())
    shown = int(total[0])
    for shift in (fit.SORT_DIGIT_BITS, 2 * fit.SORT_DIGIT_BITS):
        backend.launch("sort_count", (blocks,), shown, shift, keys_a, buffers.digits)
        backend.launch("exclusive_scan", (1,), fit.SORT_DIGITS, blocks, buffers.digits)
        backend.launch("sort_scatter", (blocks,), shown, shift, keys_a, ids_a, buffers.digits, keys_b, ids_b)
        (keys_a, ids_a), (keys_b, ids_b) = (keys_b, ids_b), (keys_a, ids_a)
    return shown, pairs


def split_batches(backend: Backend, buffers: ViewBuffers, shown: int) -> list[tuple[int, int]]:
    """Split the depth order of `shown` splats into batches, each from a first splat up to a last one, whose pairs fit.

    The device counts pairs piece by piece: the counts of millions of splats would take more of the host than a limit allows.
    """
    batches, start, stop, held = [], 0, 0, 0
    most = backend.tile_blocks * MOST_COUNTED // buffers.size.tiles
    for first in range(0, shown, most):
        for end, pairs in _pieces(backend, buffers, first, min(most, shown - first)):
            if held + pairs > buffers.capacity:
                batches.append((start, stop))
                start, held = stop, 0
            stop, held = end, held + pairs
    return [*batches, (start, stop)]


def _pieces(backend: Backend, buffers: ViewBuffers, start: int, count: int) -> Iterator[tuple[int, int]]:
    """End and most pairs of each piece of a part of the depth order: one splat, or not too many pairs for a full batch."""
    blocks = backend.tile_blocks
    backend.launch("tile_room", (blocks,), start, count, buffers.sorted[0][1], buffers.bounds, buffers.pair_room)
    room = backend.read(buffers.pair_room)[0]
    for block, pairs in enumerate(map(int, room)):
        first, stop = (start + count * place // blocks for place in (block, block + 1))
        if stop - first > 1 and pairs > buffers.capacity // PIECES:
            yield from _pieces(backend, buffers, first, stop - first)
        elif stop > first:
            yield stop, pairs


def list_tiles(backend: Backend, buffers: ViewBuffers, camera: Camera, start: int, count: int) -> None:
    """List the pairs of `count` splats, from place `start` of the depth order on, tile by tile."""
    blocks = backend.tile_blocks
    ids = buffers.sorted[0][1]
    backend.launch("tile_room", (blocks,), start, count, ids, buffers.bounds, buffers.pair_room)
    backend.launch(
        "tile_count", (blocks,), start, count, camera.width, camera.height, ids, buffers.records,
        buffers.pair_room, buffers.drafts, buffers.ends,
    )  # fmt: skip
    backend.launch("exclusive_scan", (1,), buffers.size.tiles, blocks, buffers.ends)
    backend.launch(
        "tile_scatter", (blocks,), buffers.size.tiles, buffers.pair_room, buffers.drafts, buffers.ends, buffers.pairs
    )
