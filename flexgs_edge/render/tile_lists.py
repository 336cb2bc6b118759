"""Sort the splats of a view by depth, and list them tile by tile."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.fit import SORT_DIGIT_BITS, SORT_DIGITS
from flexgs_edge.render.view_buffers import ViewBuffers

PIECES = 8  # A batch has at least so many pieces, so that at most one part in so many of its room stays empty
MOST_COUNTED = 2**32 - 1  # Most pairs that the device counts in one block


def sort_splats(backend: Backend, buffers: ViewBuffers, count: int) -> tuple[int, int]:
    """Sort the shown ones of `count` splats by depth into `buffers.sorted[0]`; return their number and a bound on their pairs."""
    blocks = backend.sort_blocks
    (keys_a, ids_a), (keys_b, ids_b) = buffers.sorted
    cells = SORT_DIGITS * blocks
    backend.launch(
        "sort_count_first", (blocks,), count, buffers.keys, buffers.bounds, buffers.digits, buffers.block_pairs
    )
    backend.launch("exclusive_scan", (1,), SORT_DIGITS, blocks, buffers.digits)
    backend.launch("sort_scatter_first", (blocks,), count, buffers.keys, buffers.digits, keys_a, ids_a)
    total = backend.read(buffers.digits, np.empty(1, np.uint32), cells, waits=False)
    pairs = int(backend.read(buffers.block_pairs).sum())
    shown = int(total[0])
    for shift in (SORT_DIGIT_BITS, 2 * SORT_DIGIT_BITS):
        backend.launch("sort_count", (blocks,), shown, shift, keys_a, buffers.digits)
        backend.launch("exclusive_scan", (1,), SORT_DIGITS, blocks, buffers.digits)
        backend.launch("sort_scatter", (blocks,), shown, shift, keys_a, ids_a, buffers.digits, keys_b, ids_b)
        (keys_a, ids_a), (keys_b, ids_b) = (keys_b, ids_b), (keys_a, ids_a)
    return shown, pairs


def split_batches(backend: Backend, buffers: ViewBuffers, shown: int) -> list[tuple[int, int]]:
    """Split the depth order of `shown` splats into batches, each from a first splat up to a last one, whose pairs fit.

    The device counts pairs piece by piece: the counts of millions of splats would take more of the host than a limit allows.
    """
    batches, start, stop, held = [], 0, 0, 0
    most = backend.tile_blocks * MOST_COUNTED // buffers.tiles
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
    backend.launch("exclusive_scan", (1,), buffers.tiles, blocks, buffers.ends)
    backend.launch(
        "tile_scatter", (blocks,), buffers.tiles, buffers.pair_room, buffers.drafts, buffers.ends, buffers.pairs
    )
