"""Twin of `cl_kernels/blend_cpu.cl` and `blend_gpu.cl`.

Works on all 4x4 blocks of a group of tiles at once: step k blends the k-th splat of every block that has one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.constants import ALPHA_MAX, ALPHA_MIN, BLOCK, FIXED_POINT_BITS, TILE, TRANSMITTANCE_MIN
from flexgs_edge.kernels.twins.arithmetic import f32, fexp2, fma

TILES_AT_ONCE = 256
"""Bounds the twin's memory: block lists and, for statistics, one float a pixel of each listed block."""

_LANE = np.arange(BLOCK * BLOCK)
_LANE_X, _LANE_Y = (_LANE % BLOCK).astype(f32), (_LANE // BLOCK).astype(f32)


@dataclass
class _Lists:
    """Splats of each block: entries [starts[u], starts[u] + counts[u]) of block u index `pair`."""

    pair: np.ndarray
    starts: np.ndarray
    counts: np.ndarray


def _block_lists(tile: np.ndarray, masks: np.ndarray, tiles: int) -> _Lists:
    pair, block = np.nonzero(masks[:, None] >> np.arange(16, dtype=np.uint32) & np.uint32(1))
    unit = tile[pair] * 16 + block
    order = np.argsort(unit, kind="stable")
    counts = np.bincount(unit, minlength=tiles * 16)
    return _Lists(pair[order], np.cumsum(counts) - counts, counts)


def _add_statistics(
    lists: _Lists, weight: np.ndarray, rows_of: np.ndarray, hits: np.ndarray, sums: np.ndarray, rows: int
) -> None:
    """Hits and fixed-point weights, summed in the kernel's order: lanes over blocks, then the pairwise tree over lanes."""
    pairs = len(rows_of)
    # Entries are ordered by block, so that adding them in order is adding block after block for each pair.
    lanes = np.zeros((pairs, 16), f32)
    block = np.repeat(np.arange(len(lists.counts)) % 16, lists.counts)
    for b in range(16):
        chosen = np.flatnonzero(block == b)
        lanes[lists.pair[chosen]] += np.maximum(weight[chosen], 0)
    count = np.bincount(lists.pair, weights=(weight >= 0).sum(axis=1), minlength=pairs).astype(np.uint32)
    eight = lanes[:, :8] + lanes[:, 8:]
    four = eight[:, :4] + eight[:, 4:]
    total = (four[:, 0] + four[:, 2]) + (four[:, 1] + four[:, 3])
    fixed = (total * f32(2.0**FIXED_POINT_BITS)).astype(np.uint64)
    np.add.at(hits, rows_of, count)
    words = sums.astype(np.uint64)
    both = words[0] + (words[1] << np.uint64(32))
    np.add.at(both, rows_of, fixed)
    sums[0] = both & np.uint64(0xFFFFFFFF)
    sums[1] = both >> np.uint64(32)


def blend(
    size: tuple[int, ...],
    tiles_x: int,
    blocks: int,
    width: int,
    height: int,
    resume: int,
    finish: int,
    background_r: float,
    background_g: float,
    background_b: float,
    ends: np.ndarray,
    pairs: np.ndarray,
    records: np.ndarray,
    state: np.ndarray,
    image: np.ndarray,
    hits: np.ndarray | None = None,
    weights: np.ndarray | None = None,
    rows: int = 0,
) -> None:
    """Blend the tile lists into `state`, and into `image` ([3, padded height, padded width]) at the end."""
    tile_ends = np.concatenate([[0], ends[blocks - 1 : size[0] * blocks : blocks].astype(np.int64)])
    background = np.array([background_r, background_g, background_b], f32)
    for first in range(0, size[0], TILES_AT_ONCE):
        last = min(first + TILES_AT_ONCE, size[0])
        counts = np.diff(tile_ends[first : last + 1])
        part = pairs[tile_ends[first] : tile_ends[last]]
        lists = _block_lists(np.repeat(np.arange(last - first), counts), part[:, 1], last - first)
        unit = np.arange((last - first) * 16)
        x0 = ((first + unit // 16) % tiles_x) * TILE + BLOCK * (unit % 4)
        y0 = ((first + unit // 16) // tiles_x) * TILE + BLOCK * (unit % 16 // 4)
        px, py = x0.astype(f32)[:, None] + _LANE_X, y0.astype(f32)[:, None] + _LANE_Y
        if resume:
            own = state[first:last].reshape(-1, 4, 16, 16).transpose(1, 0, 2, 3).reshape(4, -1, 16)
            colour, trans = own[:3].copy(), own[3].copy()
        else:
            colour = np.zeros((3, len(unit), 16), f32)
            trans = np.where((px < f32(width)) & (py < f32(height)), f32(1), f32(-1))
        weight = _blend_blocks(lists, part[:, 0], records, px, py, colour, trans, hits is not None)
        if weight is not None and hits is not None and weights is not None:
            _add_statistics(lists, weight, part[:, 0], hits, weights, rows)
        if finish:
            out = fma(np.abs(trans), background[:, None, None], colour)
            ys, xs = py.astype(np.int64), px.astype(np.int64)
            image[:, ys, xs] = out
        else:
            own = np.concatenate([colour, trans[None]]).reshape(4, last - first, 16, 16)
            state[first:last] = own.transpose(1, 0, 2, 3).reshape(last - first, 4, 256)


def _blend_blocks(
    lists: _Lists,
    rows_of: np.ndarray,
    records: np.ndarray,
    px: np.ndarray,
    py: np.ndarray,
    colour: np.ndarray,
    trans: np.ndarray,
    keep_weights: bool,
) -> np.ndarray | None:
    """Blend every block's list; returns alpha T by entry and lane (-1 where it was no hit) when asked for."""
    weight_of = np.full((len(lists.pair), 16), -1, f32) if keep_weights else None
    by_length = np.argsort(-lists.counts, kind="stable")
    lengths = lists.counts[by_length]
    for step in range(int(lengths[0]) if len(lengths) else 0):
        units = by_length[: np.searchsorted(-lengths, -step)]
        units = units[(trans[units] > 0).any(axis=1)]
        if not len(units):
            break
        entry = lists.starts[units] + step
        r = records[rows_of[lists.pair[entry]]]
        dx, dy = px[units] - r[:, 0:1], py[units] - r[:, 1:2]
        q = fma(fma(r[:, 2:3], dx, r[:, 3:4] * dy), dx, (r[:, 4:5] * dy) * dy)
        alpha = np.fmin(fexp2(r[:, 5:6] - np.fmax(q, f32(0))), f32(ALPHA_MAX))
        t = trans[units]
        after = t * (f32(1) - alpha)
        seen = alpha >= f32(ALPHA_MIN)
        hit = seen & (after >= f32(TRANSMITTANCE_MIN))
        weight = np.where(hit, alpha * t, f32(0))
        for channel in range(3):
            colour[channel, units] = fma(weight, r[:, 6 + channel : 7 + channel], colour[channel, units])
        trans[units] = np.where(hit, after, np.where(seen, -np.abs(t), t))
        if weight_of is not None:
            weight_of[entry] = np.where(hit, weight, f32(-1))
    return weight_of
