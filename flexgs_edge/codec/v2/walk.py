"""The walk over a chunk that fitting, encoding and decoding share: the order of all symbols, and what predicts each.

A port codes the batches. Encoding ports are given the codes; a decoding port returns them. Positions are an octree: one byte a
node tells which of its children are occupied, level by level from the root.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.codec.v2.groups import Features, GroupKind, Term
from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.constants import CHILD_CLASSES, COARSE_ROWS, LEVEL_CLASSES, VALUE_LIMIT
from flexgs_edge.grid.step_sizes import POSITION_BITS

REACH = (4, 2)
"""Neighbours on each side: for base channels, then for SH. SH have many channels, so they take fewer neighbours, which
saves time and costs few bits: docs/results/tuning.md#codec"""
ONE = 256  # Features are integers in units of 1/256 of a code
COLOURS = ("Y", "Co", "Cg")
_OWN = 3  # Number of features from the channel's own neighbours: mean, spread and distance
_NEAR = (2,)  # Place of the distance's weight
_SCALES = ("scale x", "scale y", "scale z")
_EARLIER: dict[str, tuple[str, ...]] = {
    "scale x": (),
    "scale y": ("scale x",),
    "scale z": ("scale x", "scale y"),
    "opacity": _SCALES,
    "dc Y": ("opacity", *_SCALES),
    "dc Co": ("dc Y", "opacity"),
    "dc Cg": ("dc Y", "dc Co"),
    "sh degree": ("opacity", "dc Y", "dc Co", "dc Cg"),
    "rotation x": _SCALES,
    "rotation y": _SCALES,
    "rotation z": _SCALES,
}  # Base channels in order, and the earlier channels that predict each of them
_SOURCES = ("scale x", "scale y", "scale z", "opacity", "dc Y", "dc Co", "dc Cg")
"""Channels that predict others. Each gives three features in this order: value, neighbours' mean, distance."""
_SH_SOURCES = ("opacity", *_SCALES)
"""Channels that predict SH. Opacity and scale tell how strongly a row's light changes; rotations tell little."""
_SH_BEFORE = ((3,), (11, 3, 9, 10), (3, 13, 14, 9, 10, 11, 12))
"""Places of weights for features of the same coefficient and those before, for the planes Y, Co and Cg. The features
are the sums of |Cg|, |Y|, |Co| so far, then Y, |Y|, Co, |Co|. Y and Co use them from the second on, Cg from the
first."""
_RESIDUAL = ("scale", "opacity", "dc")
"""Channels whose symbols are residuals: they are predictable and have no sharp limits. Other channels code their
values."""


@dataclass(frozen=True, eq=False)
class Pass:
    """Rows of one pass, and their neighbours."""

    rows: slice  # the rows, with a step
    known: slice  # the rows decoded before
    # [2 * reach, m] f32 weights of the neighbours, with a sum of about 256; None for the first pass.
    weights: np.ndarray | None
    stride: int = 1  # `rows` holds one in so many rows of the pass; 1 for all


@dataclass(frozen=True, eq=False)
class Plan:
    """All passes, and a feature of each row: 256 * bits of the squared distance to the nearest neighbour (0 in the first)."""

    passes: list[Pass]
    near: Features


def plan_passes(position: np.ndarray, reach: int, stride: int = 1) -> Plan:
    """Plan the passes over the rows of a chunk.

    `position`: [3, n], integer cells. `reach`: neighbours on each side. `stride`: take a sample of one in so many rows
    of each pass; 1 by default, for all rows.
    """
    count = position.shape[1]
    near = Features(1, count)
    if count == 0:
        return Plan([], near)
    top = max((count - 1) // COARSE_ROWS, 0).bit_length()
    points = np.ascontiguousarray(position, np.float32)
    passes = [Pass(slice(0, count, stride << top), slice(0, 0), None, stride)]
    for k in range(top - 1, -1, -1):
        rows, known = slice(1 << k, count, (2 << k) * stride), slice(0, count, 2 << k)
        here = points[:, rows]
        squares = np.zeros((2 * reach, here.shape[1]), np.float32)
        for axis in range(3):
            away = _neighbours(points[axis, known], here.shape[1], reach, stride) - here[axis]
            away *= away
            squares += away
        bits = np.frexp(squares.min(axis=0) + np.float32(1))[1]
        near.values[0, rows] = bits * np.float32(ONE)
        squares += np.float32(1)
        np.divide(np.float32(1), squares, out=squares)
        total = squares[0].copy()
        for square in squares[1:]:
            total += square
        squares *= np.float32(ONE) / total
        passes.append(Pass(rows, known, np.rint(squares, out=squares), stride))
    near.seal()
    return Plan(passes, near)


def _neighbours(known: np.ndarray, count: int, reach: int, stride: int) -> np.ndarray:
    """[2 * reach, count], the neighbours of `count` rows: row j lies between `known` j and j + 1. The ends are repeated."""
    padded = np.concatenate([np.repeat(known[:1], reach - 1), known, np.repeat(known[-1:], reach)])
    # Overlapping views of one array; as_strided does the same, but slowly.
    step = padded.itemsize
    return np.ndarray((2 * reach, count), padded.dtype, padded, 0, (step, stride * step))


def neighbour_features(values: np.ndarray, step: Pass) -> tuple[np.ndarray, ...]:
    """Weighted mean and spread of the neighbours in a pass, each [m] f32 in 1/256; an empty tuple in the first pass.

    `values`: [n] f32 values of the channel; those at `step.known` are decoded. `step`: the pass.
    """
    if step.weights is None:
        return ()
    reach, count = len(step.weights) // 2, step.weights.shape[1]
    there = _neighbours(values[step.known], count, reach, step.stride)
    # All products and sums are integers that float32 holds, so their order does not matter.
    parts = step.weights * there
    mean = np.add.reduce(parts, axis=0)
    middle = mean * np.float32(1 / ONE)
    middle += np.float32(0.5)
    np.floor(middle, middle)
    np.subtract(there, middle, parts)
    np.abs(parts, parts)
    parts *= step.weights
    return mean, np.add.reduce(parts, axis=0)


def limited(values: np.ndarray) -> np.ndarray:
    """Clip values [n] to the range that predictions use, as f32."""
    kept: np.ndarray = values.astype(np.float32)
    return np.clip(kept, np.float32(-VALUE_LIMIT), np.float32(VALUE_LIMIT), out=kept)


def base_kinds() -> list[GroupKind]:
    """The groups of the base channels."""
    return [
        GroupKind(name, _OWN + 3 * len(earlier), name.startswith(_RESIDUAL), name == "sh degree")
        for name, earlier in _EARLIER.items()
    ]


def sh_kinds(sh_degree: int) -> list[GroupKind]:
    """The groups of SH: one for each degree and colour plane."""
    return [
        GroupKind(f"sh {degree} {colour}", _OWN + 6 + 3 * plane, False, True)
        for degree in range(1, sh_degree + 1)
        for plane, colour in enumerate(COLOURS)
    ]


@dataclass(frozen=True, eq=False)
class ChunkCodes:
    """The codes of a chunk, as in `GridScene`; positions are relative to the lowest cell of the scene."""

    cells: np.ndarray  # [r] u64, Morton index of every row's cell
    base: dict[str, np.ndarray]  # each [r]
    sh: tuple[np.ndarray, ...]
    coordinates: np.ndarray | None = None  # [3, r] i32, coordinates of the cells, if a decoder has made them

    @property
    def position(self) -> np.ndarray:
        """[3, r] i32, coordinates of the rows' cells."""
        return unmorton(self.cells) if self.coordinates is None else self.coordinates


class Port(Protocol):
    """Codes batches for `walk_chunk`; `codes` and `symbols` are None to decode. The port chooses the type `known` returns."""

    stride: int  # One in so many rows of each pass is coded

    def occupancy(self, contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        """Code the bytes of octree nodes."""

    def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
        """Code the number of rows beyond the first one in every cell."""

    def known(self, group: int, count: int, terms: list[Term], before: Any = None) -> Any:
        """Take features of a group that are known for all `count` rows, in addition to those of `before`."""

    def channel(
        self, group: int, known: Any, rows: slice, own: tuple[np.ndarray, ...], codes: np.ndarray | None
    ) -> np.ndarray:
        """Code a channel for some rows, from `known` and from `own`, the mean and spread of their neighbours: codes [m]."""


def walk_chunk(
    rows: int, depth: int, sh_degree: int, port: Port, codes: ChunkCodes | None, base_only: bool
) -> ChunkCodes:
    """Code a chunk.

    `rows`: rows of the chunk. `depth`: depth of the octree. `sh_degree`: SH degree of the scene. `port`: codes the
    batches. `codes`: codes to encode; None to decode. `base_only`: stop before the SH. Returns the codes; without SH if
    `base_only`.
    """
    cells = walk_positions(rows, depth, port, codes)
    position = unmorton(cells)
    plan = plan_passes(position, REACH[0], port.stride)
    features = Features(3 * len(_SOURCES), rows)
    base: dict[str, np.ndarray] = {}
    for group, (name, earlier) in enumerate(_EARLIER.items()):
        if name == "sh degree" and sh_degree == 0:
            base[name] = np.zeros(rows, np.int32)
            continue
        terms = [Term(_NEAR, plan.near)]
        if earlier:
            first = min(map(_SOURCES.index, earlier))
            order = sorted(earlier, key=_SOURCES.index)
            places = [_OWN + 3 * earlier.index(e) + part for e in order for part in range(3)]
            terms.append(Term(places, features, 3 * first))
        mean = features.values[3 * _SOURCES.index(name) + 1] if name in _SOURCES else None
        known = port.known(group, rows, terms)
        source = None if codes is None else codes.base[name]
        result, values = _walk_channel(group, known, port, plan, rows, source, mean)
        if name == "sh degree" and (result.min(initial=0) < 0 or result.max(initial=0) > sh_degree):
            raise StreamError(f"sh degree: wanted 0 to {sh_degree}, got {result.min()} to {result.max()}")
        base[name] = result
        if mean is not None:
            at = 3 * _SOURCES.index(name)
            value, _, away = features.values[at : at + 3]
            np.multiply(values, np.float32(ONE), value)
            np.abs(np.subtract(value, mean, away), away)
            features.seal(at, at + 3)
    if base_only:
        return ChunkCodes(cells, base, ())
    return ChunkCodes(cells, base, tuple(_walk_sh(position, base, features, sh_degree, port, codes)))


def _walk_channel(
    group: int, known: Any, port: Port, plan: Plan, rows: int, source: np.ndarray | None, mean: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Code one channel: codes [rows] i32 and values [rows] f32. The neighbours' means are written into `mean`."""
    if source is None:
        result, values = np.empty(rows, np.int32), np.empty(rows, np.float32)
    else:
        result, values = source, limited(source)
    for step in plan.passes:
        own = neighbour_features(values, step)
        batch = port.channel(group, known, step.rows, own, None if source is None else source[step.rows])
        if source is None:
            result[step.rows] = batch
            values[step.rows] = limited(batch)
        if mean is not None:
            # The first pass has no neighbours: later channels then take the value itself as the mean.
            mean[step.rows] = own[0] if own else values[step.rows] * np.float32(ONE)
    return result, values


def walk_positions(rows: int, depth: int, port: Port, codes: ChunkCodes | None) -> np.ndarray:
    """Code the cells of all rows ([r] u64): the octree of cells, then the number of rows in each cell."""
    if codes is None:
        unique = walk_octree(depth, rows, port.occupancy)
        return np.repeat(unique, port.repeats(None, len(unique), rows) + 1)
    first = np.flatnonzero(np.diff(codes.cells, prepend=~codes.cells[:1]))
    walk_octree(depth, rows, port.occupancy, codes.cells[first])
    port.repeats(np.diff(first, append=rows) - 1, len(first), rows)
    return codes.cells


def _walk_sh(
    position: np.ndarray,
    base: dict[str, np.ndarray],
    features: Features,
    sh_degree: int,
    port: Port,
    codes: ChunkCodes | None,
) -> Iterator[np.ndarray]:
    """Yield the SH codes of every degree l from 1: [3 * (2l + 1), rows] i32."""
    degrees = base["sh degree"]
    rows = np.arange(len(degrees))
    below = np.zeros((3, len(rows)), np.float32)
    group = len(_EARLIER)
    plan = Plan([], Features(1, 0))
    sources = [3 * _SOURCES.index(name) for name in _SH_SOURCES]
    for degree in range(1, sh_degree + 1):
        keep = degrees[rows] >= degree
        below, rows = below[:, keep], rows[keep]
        if degree == 1 or not keep.all():
            plan = plan_passes(position[:, rows], REACH[1], port.stride)
        # These features are the same for all coefficients of the degree.
        steady = Features(3 + len(sources), len(rows))
        steady.values[:3], steady.values[3:] = below, features.values[sources][:, rows]
        steady.seal()
        extra = [Term(_NEAR, plan.near), Term((5, 6, 7, 8), steady, 3)]
        fixed = [port.known(group + plane, len(rows), [*extra, Term((4,), steady, plane)]) for plane in range(3)]
        band = np.zeros((3, 2 * degree + 1, len(rows)), np.int32)
        # Sums of |Cg|, |Y|, |Co| so far; then Y, |Y|, Co, |Co| of this coefficient.
        before = Features(7, len(rows))
        for k in range(2 * degree + 1):
            last = np.zeros(0, np.float32)
            for plane in range(3):
                term = Term(_SH_BEFORE[plane], before, 0 if plane == 2 else 1)
                known = port.known(group + plane, len(rows), [term], fixed[plane])
                source = None if codes is None else codes.sh[degree - 1][plane * (2 * degree + 1) + k]
                band[plane, k], last = _walk_channel(group + plane, known, port, plan, len(rows), source)
                last *= np.float32(ONE)
                if plane < 2:
                    before.values[3 + 2 * plane] = last
                    np.abs(last, before.values[4 + 2 * plane])
                    before.seal(3 + 2 * plane, 5 + 2 * plane)
            before.values[0] += np.abs(last, last)
            before.values[1:3] += before.values[4::2]
            before.seal(0, 3)
        below = np.minimum(before.values[[1, 2, 0]], np.float32(VALUE_LIMIT * ONE))
        group += 3
        yield band.reshape(6 * degree + 3, len(rows))


OCTREE_CONTEXTS = LEVEL_CLASSES * CHILD_CLASSES

_CHILDREN = np.array([bin(byte).count("1") for byte in range(256)], np.uint8)
_THREE = np.uint64(3)

Code = Callable[[np.ndarray, np.ndarray | None], np.ndarray]
"""Codes a batch: takes contexts [m] and symbols [m] (None to decode), and returns the symbols."""


class TooManyNodes(ValueError):
    """A level of the octree has more nodes than the chunk has rows."""


def walk_octree(depth: int, rows: int, code: Code, cells: np.ndarray | None = None) -> np.ndarray:
    """Code the set of occupied cells of a cube of 2^depth cells.

    Bit c of a node's byte is set if child c is occupied, where c is the next three bits of the Morton index. Nodes come
    in Morton order, and each level is one batch.

    `depth`: 0 to 21. `rows`: most nodes of a level. `code`: codes a batch. `cells`: [m] u64 Morton indices, ascending
    without repeats; None to decode. Returns [m] u64 Morton indices of the occupied cells, ascending.
    """
    nodes = np.zeros(1, np.uint64)
    children = np.zeros(1, np.uint8)  # for each node, the number of its parent's children
    for level in range(depth - 1, -1, -1):
        context = min(level, LEVEL_CLASSES - 1) * CHILD_CLASSES + np.minimum(children, CHILD_CLASSES - 1)
        occupancy = code(context, None if cells is None else _occupancy(cells, level))
        counts = _CHILDREN[occupancy]
        if int(counts.sum(dtype=np.int64)) > rows:
            raise TooManyNodes(
                f"octree: wanted at most {rows} nodes at level {level}, got {counts.sum(dtype=np.int64)}"
            )
        octants = np.flatnonzero(np.unpackbits(occupancy.astype(np.uint8), bitorder="little")).astype(np.uint64)
        nodes = np.repeat(nodes << _THREE, counts) | (octants & np.uint64(7))
        children = np.repeat(counts, counts)
    return nodes


def _occupancy(cells: np.ndarray, level: int) -> np.ndarray:
    """[nodes] u8, the bytes of the nodes that are 2^(level + 1) cells wide."""
    children = cells >> np.uint64(3 * level)
    children = children[np.flatnonzero(np.diff(children, prepend=~children[:1]))]
    parents = children >> _THREE
    starts = np.flatnonzero(np.diff(parents, prepend=~parents[:1]))
    bits = np.uint8(1) << (children & np.uint64(7)).astype(np.uint8)
    return np.bitwise_or.reduceat(bits, starts)


def unmorton(index: np.ndarray) -> np.ndarray:
    """[3, n] i32: inverse of `flexgs_edge.scene.curve.morton`.

    >>> from flexgs_edge.scene.curve import morton
    >>> unmorton(morton(np.array([[1, 0], [0, 0], [0, 3]]))).tolist()
    [[1, 0], [0, 0], [0, 3]]
    """
    cells = np.empty((3, len(index)), np.int32)
    for axis in range(3):
        cells[axis] = _gather(index >> np.uint64(2 - axis))
    return cells


def _gather(bits: np.ndarray) -> np.ndarray:
    """Keep every third bit, and move the kept bits together."""
    bits = bits & np.uint64(0x1249249249249249)
    for shift, mask in (
        (2, 0x10C30C30C30C30C3),
        (4, 0x100F00F00F00F00F),
        (8, 0x1F0000FF0000FF),
        (16, 0x1F00000000FFFF),
        (32, (1 << POSITION_BITS) - 1),
    ):
        bits = (bits | bits >> np.uint64(shift)) & np.uint64(mask)
    return bits
