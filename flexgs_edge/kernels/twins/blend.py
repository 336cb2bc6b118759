"""Twin of `cl_kernels/blend_cpu.cl` and `blend_gpu.cl`.

All 4x4 blocks of a group of tiles are blended at once: step k blends the k-th splat of every block that has one.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np

from flexgs_edge.constants import (
    ALPHA_MAX,
    BLOCK,
    FIXED_ERROR,
    FIXED_LARGEST,
    FIXED_MOMENT,
    FIXED_WEIGHT,
    LOG2_ALPHA_MIN,
    TILE,
    TRANSMITTANCE_MIN,
)
from flexgs_edge.kernels.twins.arithmetic import Array, Size, f32, fexp2_within, fma, splat_exponent

TILES_AT_ONCE = 256
"""Tiles of a group. It bounds the twin's memory: block lists and, for statistics, one float a pixel of each listed block."""

_LANE = np.arange(BLOCK * BLOCK)
_LANE_X, _LANE_Y = (_LANE % BLOCK).astype(f32), (_LANE // BLOCK).astype(f32)


@dataclass
class _Lists:
    """The splats of each block: those of block u are entries [starts[u], starts[u] + counts[u]) of `pair`."""

    pair: Array
    starts: Array
    counts: Array


def _block_lists(tile: Array, masks: Array, tiles: int) -> _Lists:
    pair, block = np.nonzero(masks[:, None] >> np.arange(16, dtype=np.uint32) & np.uint32(1))
    unit = tile[pair] * 16 + block
    order = np.argsort(unit, kind="stable")
    counts = np.bincount(unit, minlength=tiles * 16)
    return _Lists(pair[order], np.cumsum(counts) - counts, counts)


@dataclass
class _Entries:
    """Statistics of every list entry and lane: hits, weights, and the squared error of removal.

    For gradients, `error` is the gradient of the exponent, and `place` ([2, entries, 16]) is the pixel relative to the
    splat's centre.
    """

    hit: Array
    weight: Array
    error: Array
    place: Array


def _fixed(lanes: Array, unit: float, tiles: int) -> Array:
    """[pairs] i64, sums of [pairs, 16] lanes: the pairwise tree, then fixed point, clamped to a tile's part of 64 bits."""
    largest = f32(FIXED_LARGEST / 2.0 ** tiles.bit_length())
    eight = lanes[:, :8] + lanes[:, 8:]
    four = eight[:, :4] + eight[:, 4:]
    total = (four[:, 0] + four[:, 2]) + (four[:, 1] + four[:, 3])
    return np.clip(total * f32(unit), -largest, largest).astype(np.int64)


PLANES = {
    1: ("weight",),
    2: ("error", "square"),
    3: ("weight", "red", "green", "blue"),
    4: ("weight", "red", "green", "blue", "error", "square"),
    5: ("red", "green", "blue", "slope", "x", "y", "xx", "xy", "yy"),
}  # Planes of the fixed-point sums, for each kind of statistics
UNITS = {"error": FIXED_ERROR, "square": FIXED_ERROR} | dict.fromkeys(PLANES[5][4:], FIXED_MOMENT)
"""Units of the planes whose unit is not 1 / FIXED_WEIGHT."""


def _add_moments(lanes: dict[str, Array], pair: Array, slope: Array, place: Array) -> None:
    """Add gradients of the exponent, times powers of the pixel's place, in the kernel's order."""
    dx, dy = place
    slope_x, slope_y = slope * dx, slope * dy
    for name, part in (("slope", slope), ("x", slope_x), ("y", slope_y)):
        lanes[name][pair] += part
    for name, one, other in (("xx", slope_x, dx), ("xy", slope_x, dy), ("yy", slope_y, dy)):
        lanes[name][pair] = fma(one, other, lanes[name][pair])


def _add_sums(
    stats: int, tiles: int, lists: _Lists, entries: _Entries, rest: Array | None, rows_of: Array, hits: Array,
    sums: Array,
) -> None:  # fmt: skip
    """Add to hits and to the fixed-point sums, in the kernel's order: lanes over blocks, then the tree over lanes.

    `rest` is the residual, [3, units, 16].
    """
    planes = PLANES[stats]
    lanes = {name: np.zeros((len(rows_of), 16), f32) for name in planes}
    owner = np.repeat(np.arange(len(lists.counts)), lists.counts)
    for b in range(16):
        chosen = np.flatnonzero(owner % 16 == b)
        pair, weight = lists.pair[chosen], entries.weight[chosen]
        if "weight" in lanes:
            lanes["weight"][pair] += weight
        if "error" in lanes:
            lanes["error"][pair] += entries.error[chosen]
            lanes["square"][pair] = fma(weight, weight, lanes["square"][pair])
        if "red" in lanes:
            assert rest is not None
            for c, name in enumerate(("red", "green", "blue")):
                lanes[name][pair] = fma(weight, rest[c, owner[chosen]], lanes[name][pair])
        if "slope" in lanes:
            _add_moments(lanes, pair, entries.error[chosen], entries.place[:, chosen])
    count = np.bincount(lists.pair, weights=entries.hit.sum(axis=1), minlength=len(rows_of)).astype(np.uint32)
    some = count > 0
    if stats == 1:
        np.add.at(hits, rows_of, count)
    for c, name in enumerate(planes):
        unit = UNITS.get(name, FIXED_WEIGHT)
        np.add.at(sums.view(np.int64)[:, c, 0], rows_of[some], _fixed(lanes[name][some], unit, tiles))


def blend(
    size: Size, tiles_x: int, blocks: int, width: int, height: int, resume: int, finish: int, background_r: float,
    background_g: float, background_b: float, ends: Array, pairs: Array, records: Array, state: Array, image: Array,
    hits: Array | None = None, sums: Array | None = None, rest: Array | None = None, stats: int = 0,
) -> None:  # fmt: skip
    """Blend the tile lists into `state`, and in the end into `image` ([3, padded height, padded width]).

    For statistics beyond hits and weights, `image` is finished already, and only read.
    """
    tile_ends = np.concatenate([[0], ends[(blocks - 1) * size[0] : blocks * size[0]].astype(np.int64)])
    background = np.array([background_r, background_g, background_b], f32)
    pixels = 3 * size[0] * TILE**2  # arrays may have room for larger views
    image = image.reshape(-1)[:pixels].reshape(3, -1, tiles_x * TILE)
    rest = None if rest is None else rest.reshape(-1)[:pixels].reshape(image.shape)
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
        ys, xs = py.astype(np.int64), px.astype(np.int64)
        own_rest = None if rest is None else rest[:, ys, xs]
        whole = image[:, ys, xs] if stats in (2, 4, 5) else None
        if stats == 5 and not resume and whole is not None and own_rest is not None:
            # The light still to come in a pixel, times the residual, is kept in the place of red.
            red, green, blue = whole
            colour[0] = fma(blue, own_rest[2], fma(green, own_rest[1], red * own_rest[0]))
        entries = _blend_blocks(lists, part[:, 0], records, (px, py), colour, trans, stats, whole, own_rest)
        if entries is not None and hits is not None and sums is not None:
            _add_sums(stats, size[0], lists, entries, own_rest, part[:, 0], hits, sums)
        if finish and stats > 1:
            continue
        if finish:
            image[:, ys, xs] = fma(np.abs(trans), background[:, None, None], colour)
        else:
            out = np.concatenate([colour, trans[None]]).reshape(4, last - first, 16, 16)
            state[first:last] = out.transpose(1, 0, 2, 3).reshape(last - first, 4, 256)


def _blend_blocks(
    lists: _Lists, rows_of: Array, records: Array, pixels: tuple[Array, Array], colour: Array, trans: Array, stats: int,
    whole: Array | None, rest: Array | None,
) -> _Entries | None:  # fmt: skip
    """Blend every block's list into `colour` and `trans`; returns the entries for statistics if they are asked for."""
    shape = (len(lists.pair) if stats else 0, 16)
    entries = _Entries(
        np.zeros(shape, bool),
        np.zeros(shape, f32),
        np.zeros(shape if stats in (2, 4, 5) else (0, 16), f32),
        np.zeros((2, *shape) if stats == 5 else (2, 0, 16), f32),
    )
    by_length = np.argsort(-lists.counts, kind="stable")
    lengths = lists.counts[by_length]
    for step in range(int(lengths[0]) if len(lengths) else 0):
        units = by_length[: np.searchsorted(-lengths, -step)]
        units = units[(trans[units] > 0).any(axis=1)]
        if not len(units):
            break
        entry = lists.starts[units] + step
        r = records[rows_of[lists.pair[entry]]]
        dx, dy = pixels[0][units] - r[:, 0:1], pixels[1][units] - r[:, 1:2]
        exponent = splat_exponent(dx, dy, r[:, 2:3], r[:, 3:4], r[:, 4:5], r[:, 5:6])
        seen = exponent >= f32(LOG2_ALPHA_MIN)
        # The kernel's value is undefined where a splat is not seen, and is not used there.
        alpha = np.where(seen, fexp2_within(np.where(seen, exponent, f32(0))), f32(0))
        t = trans[units]
        after = fma(-alpha, t, t)
        hit = seen & (after >= f32(TRANSMITTANCE_MIN))
        weight = np.where(hit, alpha * t, f32(0))
        own = [r[:, 6 + c : 7 + c] for c in range(3)]
        trans[units] = np.where(hit, after, np.where(seen, -np.abs(t), t))
        if stats not in (3, 5):
            for c in range(3):
                colour[c, units] = fma(weight, own[c], colour[c, units])
        if not stats:
            continue
        entries.hit[entry], entries.weight[entry] = hit, weight
        ratio = weight / trans[units]
        if stats in (2, 4):
            assert whole is not None
            er, eg, eb = (fma(own[c], trans[units], colour[c, units] - whole[c, units]) for c in range(3))
            entries.error[entry] = ratio * ratio * fma(eb, eb, fma(eg, eg, er * er))
        elif stats == 5:
            assert rest is not None
            light = fma(own[2], rest[2, units], fma(own[1], rest[1, units], own[0] * rest[0, units]))
            slope = ratio * fma(light, t, -colour[0, units])
            entries.error[entry] = np.where(alpha < f32(ALPHA_MAX), slope, f32(0))
            entries.place[0, entry], entries.place[1, entry] = dx, dy
            colour[0, units] = fma(-weight, light, colour[0, units])
    return entries if stats else None


blend_stats = partial(blend, stats=1)
blend_removal = partial(blend, stats=2)
blend_residual = partial(blend, stats=3)
blend_both = partial(blend, stats=4)
blend_backward = partial(blend, stats=5)
