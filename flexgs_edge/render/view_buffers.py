"""The buffers of a view on a backend, and how many bytes they are."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera
from flexgs_edge.constants import TILE
from flexgs_edge.kernels import Backend
from flexgs_edge.render.device_scene import DeviceScene

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
COMPACT_PAIR_SHARE = 2
"""The same of compact views: tiles of several batches are listed anew for every blend."""


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


def chunk_shapes(rows: int) -> dict[str, tuple[tuple[int, ...], Any]]:
    """The same of what one chunk of a compact view is projected to."""
    return {
        "chunk_records": ((rows, 16), np.float32),
        "chunk_keys": ((rows,), np.uint32),
        "chunk_bounds": ((rows,), np.uint32),
    }


def shapes_bytes(shapes: dict[str, tuple[tuple[int, ...], Any]]) -> int:
    """Bytes of all of `view_shapes`."""
    return sum(int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def view_bytes(backend: Backend, count: int, camera: Camera) -> int:
    """Bytes of the buffers of a view of so many rows, with the shortest lists of pairs."""
    tiles = -(-camera.width // TILE) * -(-camera.height // TILE)
    return shapes_bytes(view_shapes(backend, count, camera.width, camera.height)) + PAIR_BYTES * tiles


def target_bytes(camera: Camera) -> int:
    """Bytes of a target of a view, and of the residual against it."""
    return TARGET_BYTES * 3 * TILE * TILE * -(-camera.width // TILE) * -(-camera.height // TILE)


class ViewBuffers:
    """Buffers that live as long as the views have one size and one number of rows.

    With `rows`, there is room for as many splats only, those that a view shows: the buffers of a compact view, and one chunk's
    for what `project` writes.
    """

    def __init__(
        self, backend: Backend, scene: DeviceScene, camera: Camera, budget: MemoryBudget, rows: int | None = None
    ) -> None:
        self.key = view_key(scene, camera)
        _, width, height = self.key
        self.rows = rows
        count = scene.count if rows is None else rows
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
        what = (
            f"a view of {count} Gaussians" if rows is None else f"a view that shows {count} of {scene.count} Gaussians"
        )
        if rows is not None:
            shapes |= chunk_shapes(scene.compact_rows)
            later += scene.shown_bytes * rows - scene.later_bytes
            size = shapes_bytes(shapes)
        budget.require(f"{what} at {width}x{height}", size + later)
        try:
            made = {name: self._array(shape, dtype) for name, (shape, dtype) in shapes.items()}
            if scene.targets:
                self.target_arrays()
                later -= self._target_bytes
            share, most = PAIR_SHARE, max(DEFAULT_PAIRS, self.tiles)
            if rows is not None:
                share = COMPACT_PAIR_SHARE
                # Chunks that stay take what is left, and the buffers of views that show more come after them.
                scene.give_way(later + share * most * PAIR_BYTES - budget.free)
            spare = max(budget.free - later, 0) // (share * PAIR_BYTES)
            self.capacity = min(self.tiles + spare, most)
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
        self.chunk = tuple(made[name] for name in chunk_shapes(0)) if rows is not None else ()

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
        """Free them."""
        for array in self.arrays:
            array.release()
        self.arrays = []
        self._targets = None
