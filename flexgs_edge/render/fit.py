"""How many bytes a view, a chunk and their sums take: memory policy as arithmetic."""

from __future__ import annotations

from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import LANES, TILE
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.scene.fields import FIELD


def plane_bytes(sh_degree: int) -> int:
    """Bytes a row of an activated chunk: means, covariance (or its factor), log2 of the opacity, colour."""
    return 4 * (3 + 6 + 1 + 3 + FIELD["sh_rest"].width(sh_degree))


RAW_BYTES = 4 * (3 + 4 + 1)
"""Bytes a row that loading needs on top for a moment: stored scale, rotation, opacity."""


def streamed_bytes(sh_degree: int) -> int:
    """Bytes a row of a streamed chunk, and of the one that is loaded while it is drawn."""
    return 2 * (plane_bytes(sh_degree) + RAW_BYTES)


def padded(count: int) -> int:
    """Elements of a plane that holds `count` rows."""
    return -(-count // LANES) * LANES


CAPACITY_STEP = 1 << 16
"""Compact views make room for multiples of so many rows: views of about one size then share their buffers."""
FIRST_SHARE = 4
"""Part of a scene's rows (one in four) that a compact view has room for until one shows more."""
GROWTH = 1.1
"""Room beyond what the part of a view that was seen lets expect."""
GUESS = 1.02
"""Room beyond what views have shown so far."""


def capacity(scene: DeviceScene, share: float) -> int:
    """Rows that a compact view of some of a scene's rows gets room for."""
    return min((int(share * scene.count) // CAPACITY_STEP + 1) * CAPACITY_STEP, scene.count)


CHUNK_ROWS = 1 << 18
"""Most rows of a chunk: 60 MB of planes at SH degree 3, large enough that launches cost nothing."""
MIN_CHUNK_ROWS = 1 << 10
COMPACT_ROWS = 1 << 16
"""Rows of a chunk of a scene whose views are compact: 33 MB with all that projecting it takes."""
SPARE_SHARE = 4
"""Part of the limit (one in four) that chunks of a compact scene which stay leave free."""
AHEAD_SHARE = 8
"""The same of a second chunk that is loaded ahead, whose memory is free again when a view is projected."""


def sum_bytes(planes: int) -> int:
    """Bytes a row of so many planes of 64-bit sums, and of the hits that go with a single one."""
    return 8 * planes + 4 * (planes == 1)


SUM_BYTES = sum_bytes(1)
MOST_SUMS = 6
"""Planes of sums that a view has at most (`Renderer.residual_and_removal_sums`)."""
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
