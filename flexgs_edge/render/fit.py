"""How many bytes a view, a chunk and their sums take, and what fits into the budget.

This is arithmetic only; nothing is allocated.
"""

import math
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import LANES, ROW_BLOCK, SSIM_WINDOW, TILE
from flexgs_edge.scene.fields import FIELD

Shapes = dict[str, tuple[tuple[int, ...], Any]]  # Shape and type of each array, by name

RAW_BYTES = 4 * (3 + 4 + 1)
"""Extra bytes a row while a chunk is loaded: stored scale, rotation and opacity, freed after `activate`."""
GROWTH = 1.1  # Room beyond the estimate that the part of a view projected so far gives
GUESS = 1.02  # Room beyond the largest share of rows that a view has shown so far
MOST_SUMS = 6  # Largest number of sum planes of a view (`Renderer.residual_and_removal_sums`)
GRADIENT_SUMS = 9  # Number of planes of `Renderer.gradient_sums`
SORT_DIGIT_BITS = 11
SORT_DIGITS = 1 << SORT_DIGIT_BITS
REFERENCE_BYTES = 6  # Bytes a pixel and channel of a target (f16) and of the residual against it (f32)
PAIR_BYTES = 20  # Bytes of a pair in a tile list (8) and of its draft (12)
PAIR_SHARE = 8
"""The tile lists take at most this part (one in eight) of the free memory, so that the scene gets the rest."""
COMPACT_PAIR_SHARE = 2
"""The part (one in two) for a compact view. More batches would cost it more: each blend lists their tiles anew."""
AHEAD_SHARE = 8
"""A third chunk loads ahead only if this part of the limit (one in eight) stays free. The view's end frees it again."""


@dataclass(frozen=True)
class Fit:
    """How a scene and its views share memory. Pictures and sums have the same bits with any values."""

    # Most rows of a chunk: 60 MB of planes at SH degree 3, large enough to hide the cost of a launch.
    chunk_rows: int = 1 << 18
    least_rows: int = 1 << 10  # rows of the smallest chunk of a streamed scene
    compact_rows: int = 1 << 16  # rows of a chunk if views are compact: 33 MB, with all that projecting it takes
    pairs: int = 1 << 21  # most pairs of a batch: 40 MiB, enough to draw most views in one batch
    # Compact views make room for multiples of so many rows, so that views of about one size share their buffers.
    capacity_step: int = 1 << 16
    first_share: int = 4  # a compact view first gets room for one in so many of the scene's rows
    # Chunks of a compact scene stay on the backend only if one in so many bytes of the limit is free. At 1, none stays.
    spare_share: int = 4
    ahead: int = 3  # views that are projected together with the current one
    resident: bool = True  # keep a scene that fits on the backend; if False, always stream it
    # Give a view room for all rows of its scene if memory allows; if False, all views are compact.
    whole_views: bool = True

    def capacity(self, count: int, share: float) -> int:
        """Rows that a compact view gets room for if it is to show a `share` of the scene's `count` rows."""
        return min((int(share * count) // self.capacity_step + 1) * self.capacity_step, count)


DEFAULT = Fit()  # The fit of a `Renderer` that is given none


@dataclass(frozen=True)
class ViewSize:
    """The size of a view's buffers, apart from their rows.

    `width`, `height`: pixels. `sort_blocks`, `tile_blocks`: work-items of the backend for the depth sort and for the
    tile lists.
    """

    width: int
    height: int
    sort_blocks: int
    tile_blocks: int

    @property
    def tiles_x(self) -> int:
        """Tiles from left to right."""
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        """Tiles from top to bottom."""
        return -(-self.height // TILE)

    @property
    def tiles(self) -> int:
        """Tiles in the whole view."""
        return self.tiles_x * self.tiles_y

    @property
    def pixels(self) -> int:
        """Pixels of all tiles; the last row and column of tiles may reach beyond the picture."""
        return self.tiles * TILE * TILE

    @property
    def slopes(self) -> int:
        """Elements of the slopes of its SSIM: nine planes, which end in rows that the sums of the last pixels read."""
        return 9 * (self.height + SSIM_WINDOW) * self.tiles_x * TILE


class SceneSize(Protocol):
    """The rows and bytes of a scene on a backend, as this module needs them: see `DeviceScene`."""

    count: int
    sum_bytes: int
    references: bool
    structure: bool

    @property
    def later_bytes(self) -> int: ...

    @property
    def shown_bytes(self) -> int: ...

    @property
    def whole_bytes(self) -> int: ...

    @property
    def held_bytes(self) -> int: ...

    @property
    def least_chunk_bytes(self) -> int: ...

    @property
    def compact_rows(self) -> int: ...

    @property
    def compact_chunk_bytes(self) -> int: ...


def plane_bytes(sh_degree: int) -> int:
    """Bytes a row of an activated chunk: means, covariance (or its factor), log2 of the opacity, SH."""
    return 4 * (3 + 6 + 1 + 3 + FIELD["sh_rest"].width(sh_degree))


def streamed_bytes(sh_degree: int) -> int:
    """Bytes a row of a streamed chunk, together with the chunk that loads while it is drawn."""
    return 2 * (plane_bytes(sh_degree) + RAW_BYTES)


def padded(count: int) -> int:
    """Elements of a plane that holds `count` rows: rounded up to whole vectors of `LANES`."""
    return -(-count // LANES) * LANES


def sum_bytes(planes: int) -> int:
    """Bytes a row of so many planes of 64-bit sums; a single plane has a hit counter beside it."""
    return 8 * planes + 4 * (planes == 1)


SUM_BYTES = sum_bytes(1)


def view_shapes(size: ViewSize, count: int) -> Shapes:
    """Buffers of a view of `count` rows, without the tile lists: they take a part of the memory that is left."""
    return {
        "camera": ((32,), np.float32),
        # Chunks of the usual sizes; `ViewBuffers.blocks` makes room for more.
        "blocks": ((count // ROW_BLOCK + count // 512 + 2,), np.uint32),
        "records": ((count, 16), np.float32),
        "keys": ((count,), np.uint32),
        "bounds": ((count,), np.uint32),
        "keys_a": ((count,), np.uint32),
        "ids_a": ((count,), np.uint32),
        "keys_b": ((count,), np.uint32),
        "ids_b": ((count,), np.uint32),
        "digits": ((SORT_DIGITS * size.sort_blocks + 1,), np.uint32),
        "block_pairs": ((size.sort_blocks,), np.uint64),
        "pair_room": ((2, size.tile_blocks), np.uint32),
        "ends": ((size.tiles * size.tile_blocks + 1,), np.uint32),
        "state": ((size.tiles, 4, TILE * TILE), np.float32),
        "image": ((3, size.tiles_y * TILE, size.tiles_x * TILE), np.float32),
    }


def chunk_shapes(rows: int) -> Shapes:
    """Buffers that a chunk of a compact view is projected into."""
    return {
        "chunk_records": ((rows, 16), np.float32),
        "chunk_keys": ((rows,), np.uint32),
        "chunk_bounds": ((rows,), np.uint32),
    }


def shapes_bytes(shapes: Shapes) -> int:
    """Bytes of all arrays together."""
    return sum(math.prod(map(int, shape)) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def view_bytes(size: ViewSize, count: int) -> int:
    """Bytes of a view's buffers for `count` rows, with the shortest tile lists that work."""
    return shapes_bytes(view_shapes(size, count)) + PAIR_BYTES * size.tiles


def compact_bytes(size: ViewSize, shown: int, rows: int, sh_degree: int) -> int:
    """Bytes of a compact view with room for `shown` rows, and of chunks of so many `rows` that are projected into it."""
    rows = padded(rows)
    return view_bytes(size, shown) + rows * streamed_bytes(sh_degree) + shapes_bytes(chunk_shapes(rows))


def reference_bytes(size: ViewSize) -> int:
    """Bytes of a view's target and of the residual against it."""
    return REFERENCE_BYTES * 3 * size.pixels


def structure_shapes(size: ViewSize) -> Shapes:
    """Buffers for the gradient of a view's SSIM."""
    return {"taps": ((SSIM_WINDOW,), np.float32), "slopes": ((size.slopes,), np.float32)}


def target_bytes(scene: SceneSize, size: ViewSize) -> int:
    """Bytes that a view of this scene takes to be compared with its target."""
    structure = shapes_bytes(structure_shapes(size)) if scene.structure else 0
    return scene.references * reference_bytes(size) + structure


def saves_bytes(scene: SceneSize, size: ViewSize, shown: int) -> bool:
    """Whether a compact view of `shown` rows takes less memory than a view of all rows, if sums over views lie in memory.

    Sums wider than hits and weights would need a scratch file with compact views. Then they do not save anything.
    """
    saved = view_bytes(size, scene.count) - view_bytes(size, shown)
    saved += scene.later_bytes - scene.shown_bytes * shown
    chunks = scene.compact_chunk_bytes + shapes_bytes(chunk_shapes(scene.compact_rows)) - scene.least_chunk_bytes
    return scene.sum_bytes <= SUM_BYTES and saved > chunks


def fits_whole(scene: SceneSize, size: ViewSize, free: int, spills: bool) -> bool:
    """Whether `free` bytes hold a view of all rows of the scene, and the sums over views.

    If large arrays lie in files (`spills`), half of the memory is left for the kernel's cache of their pages.
    """
    view = view_bytes(size, scene.count) + target_bytes(scene, size) + scene.later_bytes
    free += scene.held_bytes
    if spills:
        # Without cached pages, a run under a tight limit reads the same rows again and again.
        return view + scene.whole_bytes <= free // 2
    return view + scene.least_chunk_bytes <= free
