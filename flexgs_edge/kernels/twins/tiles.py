"""Twins of `cl_kernels/tiles.cl`: tile lists in depth order, with block masks."""

import numpy as np

from flexgs_edge.constants import BLOCK, SPAN_SLACK, SPAN_SLACK_RELATIVE, TILE
from flexgs_edge.kernels.twins.arithmetic import Array, Size, f32, fma
from flexgs_edge.kernels.twins.sort import block_of

EMPTY = (1 << 28, -1)  # First and last block column of a row that the splat does not touch
_BANDS = np.arange(TILE // BLOCK, dtype=np.int32)


def block_spans(records: Array, bands: Array, width: np.float32) -> tuple[Array, Array]:
    """First and last block column ([m, 4] i32) of splats ([m, 16]) over four block rows each ([m, 4]).

    The span of a row is empty if first > last.
    """
    mx, my, turn, hh, slope, ic, root_scale, level = (records[:, k : k + 1] for k in (0, 1, 9, 10, 11, 12, 13, 14))
    top = (bands * BLOCK).astype(f32) - my
    slack = fma(hh, f32(SPAN_SLACK_RELATIVE), f32(SPAN_SLACK))
    low, high = np.fmax(top, -(hh + slack)), np.fmin(top + f32(BLOCK - 1), hh + slack)
    right_dy, left_dy = np.fmin(np.fmax(turn, low), high), np.fmin(np.fmax(-turn, low), high)
    right_root = np.sqrt(np.fmax(level - right_dy * right_dy * ic, f32(0)) * root_scale)
    left_root = np.sqrt(np.fmax(level - left_dy * left_dy * ic, f32(0)) * root_scale)
    right, left = fma(slope, right_dy, right_root), fma(slope, left_dy, -left_root)
    right_slack = fma(np.abs(slope * right_dy) + right_root, f32(SPAN_SLACK_RELATIVE), f32(SPAN_SLACK))
    left_slack = fma(np.abs(slope * left_dy) + left_root, f32(SPAN_SLACK_RELATIVE), f32(SPAN_SLACK))
    x0 = np.fmin(np.fmax(np.ceil(mx + left - left_slack), f32(0)), width)
    x1 = np.fmin(np.fmax(np.floor(mx + right + right_slack), f32(-1)), width - f32(1))
    some = (low <= high) & (x0 <= x1)
    return np.where(some, x0.astype(np.int32) >> 2, EMPTY[0]), np.where(some, x1.astype(np.int32) >> 2, EMPTY[1])


def _tile_masks(first: Array, last: Array, column: Array) -> Array:
    """[m] u32, blocks of tiles in columns of tiles ([m]), bit 4 * row + column, from the spans of their rows ([m, 4])."""
    start, end = np.maximum(first - 4 * column[:, None], 0), np.minimum(last - 4 * column[:, None], 3)
    bits = ((1 << (np.clip(end, 0, 3) + 1)) - 1) & ~((1 << np.clip(start, 0, 4)) - 1)
    return np.where(start <= end, bits << (4 * _BANDS), 0).sum(axis=1).astype(np.uint32)


def only_tiles(records: Array, column: Array, row: Array, width: np.float32) -> Array:
    """[m] u32, number and mask of the only tile of splats ([m, 16]), which lies in a column and a row of tiles ([m] each)."""
    column, row = column.astype(np.int32), row.astype(np.int32)
    first, last = block_spans(records, row[:, None] * (TILE // BLOCK) + _BANDS, width)
    number = (row * np.int32(-(-int(width) // TILE)) + column).astype(np.uint32)
    return number << np.uint32(16) | _tile_masks(first, last, column)


def _expand(first: Array, last: Array) -> tuple[Array, Array]:
    """(owner, value) for every value in [first, last] of each owner."""
    counts = np.maximum(last - first + 1, 0)
    owner = np.repeat(np.arange(len(counts)), counts)
    within = np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)
    return owner, first[owner] + within


def list_pairs(ids: Array, records: Array, width: np.float32, height: np.float32) -> tuple[Array, Array, Array]:
    """(index into ids, tile, mask) of every pair, splat by splat in the order of `ids`."""
    splats = records[ids]
    tiles_x = -(-int(width) // TILE)
    slack = fma(splats[:, 10], f32(SPAN_SLACK_RELATIVE), f32(SPAN_SLACK))
    y0 = np.fmax(np.ceil(splats[:, 1] - splats[:, 10] - slack), f32(0)).astype(np.int64)
    y1 = np.fmin(np.floor(splats[:, 1] + splats[:, 10] + slack), height - f32(1)).astype(np.int64)
    splat, ty = _expand(y0 // TILE, y1 // TILE)
    first, last = block_spans(splats[splat], (ty[:, None] * (TILE // BLOCK) + _BANDS).astype(np.int32), width)
    row, tx = _expand(first.min(axis=1, initial=EMPTY[0]) >> 2, last.max(axis=1, initial=EMPTY[1]) >> 2)
    mask = _tile_masks(first[row], last[row], tx)
    keep = mask != 0
    return splat[row][keep], (ty[row] * tiles_x + tx)[keep], mask[keep]


def tile_room(size: Size, start: int, count: int, ids: Array, bounds: Array, room: Array) -> None:
    """Most drafts of each block of the depth-ordered splats [start, start + count), into `room[0]`."""
    blocks = block_of(count, size[0])
    room[0] = np.bincount(blocks, weights=bounds[ids[start : start + count]], minlength=size[0]).astype(np.uint32)


def _draft_places(room: Array) -> Array:
    """[n] i64, the places of all drafts, block by block."""
    starts = np.cumsum(room[0], dtype=np.int64) - room[0]
    return _expand(starts, starts + room[1].astype(np.int64) - 1)[1]


def tile_count(
    size: Size, start: int, count: int, width: float, height: float, ids: Array, records: Array, room: Array,
    drafts: Array, counts: Array,
) -> None:  # fmt: skip
    """Drafts (row, tile, mask) of the splats [start, start + count), and their counts by tile and block of splats."""
    batch = ids[start : start + count]
    splat, tile, mask = list_pairs(batch, records, f32(width), f32(height))
    block = block_of(count, size[0])[splat]
    room[1] = np.bincount(block, minlength=size[0])
    drafts[_draft_places(room)] = np.stack([batch[splat], tile, mask], axis=1)
    tiles = -(-int(width) // TILE) * -(-int(height) // TILE)
    counts[: size[0] * tiles] = np.bincount(block * tiles + tile, minlength=size[0] * tiles)


def tile_scatter(size: Size, tiles: int, room: Array, drafts: Array, offsets: Array, pairs: Array) -> None:
    """Write (row, mask) tile by tile in depth order; `offsets` become the ends of the cells."""
    row, tile, mask = drafts[_draft_places(room)].T
    order = np.argsort(tile, kind="stable")
    pairs[: len(order), 0] = row[order]
    pairs[: len(order), 1] = mask[order]
    cells = np.repeat(np.arange(size[0]), room[1]) * tiles + tile
    offsets[: size[0] * tiles] += np.bincount(cells, minlength=size[0] * tiles).astype(np.uint32)
