"""How many bytes a view, a chunk and their sums take, and what fits: memory policy as arithmetic on numbers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import LANES, TILE
from flexgs_edge.scene.fields import FIELD

Shapes = dict[str, tuple[tuple[int, ...], Any]]
"""Shape and type of arrays, by name."""

RAW_BYTES = 4 * (3 + 4 + 1)
"""Bytes a row that loading needs on top for a moment: stored scale, rotation, opacity."""
GROWTH = 1.1
"""Room beyond what the part of a view that was seen lets expect."""
GUESS = 1.02
"""Room beyond what views have shown so far."""
MOST_SUMS = 6
"""Planes of sums that a view has at most (`Renderer.residual_and_removal_sums`)."""
SORT_DIGIT_BITS = 11
SORT_DIGITS = 1 << SORT_DIGIT_BITS
TARGET_BYTES = 6
"""Bytes a pixel and channel of a target in half precision, and of the residual against it."""
PAIR_BYTES = 20
"""A pair (8) and its draft (12)."""
PAIR_SHARE = 8
"""The tile lists take at most this part (one in eight) of what is free beyond the least: the scene comes next."""
COMPACT_PAIR_SHARE = 2
"""The same of compact views: tiles of several batches are listed anew for every blend."""
AHEAD_SHARE = 8
"""Part of the limit (one in eight) that a second chunk which is loaded ahead leaves free: its memory is free again soon."""


@dataclass(frozen=True)
class Fit:
    """How a scene and its views share memory. Pictures and sums are the same to the bit with any of it.

    Parameters
    ----------
    chunk_rows : int
        Most rows of a chunk: 60 MB of planes at SH degree 3, large enough that launches cost nothing.
    least_rows : int
        Rows of the smallest chunk of a scene that is streamed.
    compact_rows : int
        Rows of a chunk of a scene whose views are compact: 33 MB with all that projecting it takes.
    pairs : int
        Pairs of a batch when memory allows: 40 MiB, one batch for most views.
    capacity_step : int
        Compact views make room for multiples of so many rows: views of about one size then share their buffers.
    first_share : int
        Part of a scene's rows (one in so many) that a compact view has room for until one shows more.
    spare_share : int
        Part of the limit (one in so many) that chunks of a compact scene which stay leave free; at 1 none stays.
    ahead : int
        Views that are projected with the one whose turn it is.
    resident : bool
        A scene that fits stays on the backend; else it is streamed.
    whole_views : bool
        A view has room for all rows of its scene where memory allows; else it is compact.
    """

    chunk_rows: int = 1 << 18
    least_rows: int = 1 << 10
    compact_rows: int = 1 << 16
    pairs: int = 1 << 21
    capacity_step: int = 1 << 16
    first_share: int = 4
    spare_share: int = 4
    ahead: int = 3
    resident: bool = True
    whole_views: bool = True

    def capacity(self, count: int, share: float) -> int:
        """Rows that a compact view of a `share` of a scene's `count` rows gets room for."""
        return min((int(share * count) // self.capacity_step + 1) * self.capacity_step, count)


DEFAULT = Fit()
"""What a `Renderer` takes that is given none."""


@dataclass(frozen=True)
class ViewSize:
    """What the bytes of a view's buffers depend on, besides its rows.

    Parameters
    ----------
    width, height : int
        Pixels.
    sort_blocks, tile_blocks : int
        Work-items of the backend that sort, and that list tiles.
    """

    width: int
    height: int
    sort_blocks: int
    tile_blocks: int

    @property
    def tiles_x(self) -> int:
        """Tiles side by side."""
        return -(-self.width // TILE)

    @property
    def tiles_y(self) -> int:
        """Tiles one below the other."""
        return -(-self.height // TILE)

    @property
    def tiles(self) -> int:
        """All tiles."""
        return self.tiles_x * self.tiles_y

    @property
    def pixels(self) -> int:
        """Pixels of all tiles."""
        return self.tiles * TILE * TILE


class SceneSize(Protocol):
    """What the policy asks of a scene on a backend: rows and bytes."""

    count: int
    sum_bytes: int
    targets: bool

    @property
    def later_bytes(self) -> int:
        """Bytes that sums over views will take."""

    @property
    def shown_bytes(self) -> int:
        """Bytes that each row which a compact view shows takes of the sums of one view."""

    @property
    def whole_bytes(self) -> int:
        """Bytes of all chunks, loaded."""

    @property
    def held_bytes(self) -> int:
        """Bytes that the loaded scene takes."""

    @property
    def least_chunk_bytes(self) -> int:
        """Bytes of the smallest chunk."""

    @property
    def compact_rows(self) -> int:
        """Rows that a chunk of it has room for once it is compact."""

    @property
    def compact_chunk_bytes(self) -> int:
        """Bytes of such a chunk."""


def plane_bytes(sh_degree: int) -> int:
    """Bytes a row of an activated chunk: means, covariance (or its factor), log2 of the opacity, colour."""
    return 4 * (3 + 6 + 1 + 3 + FIELD["sh_rest"].width(sh_degree))


def streamed_bytes(sh_degree: int) -> int:
    """Bytes a row of a streamed chunk, and of the one that is loaded while it is drawn."""
    return 2 * (plane_bytes(sh_degree) + RAW_BYTES)


def padded(count: int) -> int:
    """Elements of a plane that holds `count` rows."""
    return -(-count // LANES) * LANES


def sum_bytes(planes: int) -> int:
    """Bytes a row of so many planes of 64-bit sums, and of the hits that go with a single one."""
    return 8 * planes + 4 * (planes == 1)


SUM_BYTES = sum_bytes(1)


def view_shapes(size: ViewSize, count: int) -> Shapes:
    """The buffers of a view of `count` rows; the lists of pairs take what is left."""
    return {
        "camera": ((32,), np.float32),
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
    """The same of what one chunk of a compact view is projected to."""
    return {
        "chunk_records": ((rows, 16), np.float32),
        "chunk_keys": ((rows,), np.uint32),
        "chunk_bounds": ((rows,), np.uint32),
    }


def shapes_bytes(shapes: Shapes) -> int:
    """Bytes of all of them."""
    return sum(int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize for shape, dtype in shapes.values())


def view_bytes(size: ViewSize, count: int) -> int:
    """Bytes of the buffers of a view of so many rows, with the shortest lists of pairs."""
    return shapes_bytes(view_shapes(size, count)) + PAIR_BYTES * size.tiles


def target_bytes(size: ViewSize) -> int:
    """Bytes of a target of a view, and of the residual against it."""
    return TARGET_BYTES * 3 * size.pixels


def saves_bytes(scene: SceneSize, size: ViewSize, shown: int) -> bool:
    """Whether a compact view that shows `shown` rows takes less memory than one of all rows, both held in memory.

    Sums that take more than a view's own statistics need a file: then it is not worth it.
    """
    saved = view_bytes(size, scene.count) - view_bytes(size, shown)
    saved += scene.later_bytes - scene.shown_bytes * shown
    chunks = scene.compact_chunk_bytes + shapes_bytes(chunk_shapes(scene.compact_rows)) - scene.least_chunk_bytes
    return scene.sum_bytes <= SUM_BYTES and saved > chunks


def fits_whole(scene: SceneSize, size: ViewSize, free: int, spills: bool) -> bool:
    """Whether `free` bytes have room for a view of all rows of the scene, beside what sums over views will take.

    Where large arrays lie in files (`spills`), half of the memory is left for their pages.
    """
    view = view_bytes(size, scene.count) + scene.targets * target_bytes(size) + scene.later_bytes
    free += scene.held_bytes
    if spills:
        # Without pages that stay, a run under a tight limit reads the same rows again and again.
        return view + scene.whole_bytes <= free // 2
    return view + scene.least_chunk_bytes <= free
