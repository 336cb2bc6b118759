"""The one walk over a chunk that fitting, encoding and decoding share: what is coded when, and from what it is predicted.

A port codes the batches. Encoding ports are given the codes; a decoding port gives them back.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flexgs_edge.codec.contexts import (
    ONE,
    REACH,
    VALUE_LIMIT,
    Known,
    Pass,
    limited,
    neighbour_features,
    plan_passes,
)
from flexgs_edge.codec.groups import GroupKind
from flexgs_edge.codec.octree import unmorton, walk_octree
from flexgs_edge.codec.rans import StreamError

AXES = ("x", "y", "z")
COLOURS = ("Y", "Co", "Cg")
_OWN = 3
"""Features from the channel's own neighbours: mean, spread, distance."""

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
}
"""Base channels in order, and the earlier channels that each is predicted from. Each pays at least 0.01 bits."""
_RESIDUAL = ("scale", "opacity", "dc")
"""Channels whose symbols are residuals: predictable and without edges. The others gain from tables of their values."""


def base_kinds() -> list[GroupKind]:
    """Groups of the base channels."""
    return [GroupKind(name, _OWN + 3 * len(earlier), name.startswith(_RESIDUAL)) for name, earlier in _EARLIER.items()]


def sh_kinds(sh_degree: int) -> list[GroupKind]:
    """Groups of SH: one for each degree and colour plane."""
    return [
        GroupKind(f"sh {degree} {colour}", _OWN + 6 + 3 * plane, False)
        for degree in range(1, sh_degree + 1)
        for plane, colour in enumerate(COLOURS)
    ]


@dataclass(frozen=True, eq=False)
class ChunkCodes:
    """The codes of a chunk's rows, as in `GridScene`; position is relative to the scene's lowest cell."""

    cells: np.ndarray  # [r] u64, Morton index of every row's cell
    base: dict[str, np.ndarray]  # each [r]
    sh: tuple[np.ndarray, ...]


class Port(Protocol):
    """Codes batches; `codes` are None when decoding."""

    def occupancy(self, contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        """Octree bytes."""

    def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
        """Rows beyond the first in every cell."""

    def channel(self, group: int, features: list[np.ndarray], codes: np.ndarray | None) -> np.ndarray:
        """Codes [m] of a group, predicted from features (each [m] f32 in 1/256)."""


def walk_chunk(
    rows: int, depth: int, sh_degree: int, port: Port, codes: ChunkCodes | None, base_only: bool
) -> ChunkCodes:
    """Code a chunk.

    Parameters
    ----------
    rows : int
        Rows of the chunk.
    depth : int
        Of the octree.
    sh_degree : int
        Of the scene.
    port : Port
        Codes the batches.
    codes : ChunkCodes, optional
        What to encode; None when decoding.
    base_only : bool
        Stop before the SH.

    Returns
    -------
    ChunkCodes
        The codes; without SH if `base_only`.
    """
    cells = _walk_positions(rows, depth, port, codes)
    position = unmorton(cells)
    passes = plan_passes(position, REACH[0])
    known: dict[str, Known] = {}
    base: dict[str, np.ndarray] = {}
    for group, (name, earlier) in enumerate(_EARLIER.items()):
        if name == "sh degree" and sh_degree == 0:
            base[name] = np.zeros(rows, np.int32)
            continue
        source = None if codes is None else codes.base[name]
        values = np.zeros(rows, np.float32)
        mean = np.zeros(rows, np.float32)
        result = np.zeros(rows, np.int32)
        for step in passes:
            own = neighbour_features(values, step)
            features = [*own, *(part for e in earlier for part in known[e].features(step.rows))]
            result[step.rows] = port.channel(group, features, None if source is None else source[step.rows])
            values[step.rows] = limited(result[step.rows])
            # The first pass has no neighbours: as a feature of later channels its mean is its value.
            mean[step.rows] = values[step.rows] * ONE if step.weights is None else own[0]
        if name == "sh degree" and (result.min(initial=0) < 0 or result.max(initial=0) > sh_degree):
            raise StreamError(f"sh degree: wanted 0 to {sh_degree}, got {result.min()} to {result.max()}")
        base[name] = result
        known[name] = Known(values * ONE, mean)
    if base_only:
        return ChunkCodes(cells, base, ())
    return ChunkCodes(cells, base, tuple(_walk_sh(position, base, known, sh_degree, port, codes)))


def _walk_positions(rows: int, depth: int, port: Port, codes: ChunkCodes | None) -> np.ndarray:
    """[r] u64 cells of all rows: the octree, then how often each cell is taken again."""
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
    known: dict[str, Known],
    sh_degree: int,
    port: Port,
    codes: ChunkCodes | None,
) -> Iterator[np.ndarray]:
    """[3 * (2l + 1), rows] i32 for every degree l from 1."""
    degrees = base["sh degree"]
    rows = np.arange(len(degrees))
    below = np.zeros((3, len(rows)), np.float32)
    group = len(_EARLIER)
    passes: list[Pass] = []
    for degree in range(1, sh_degree + 1):
        keep = degrees[rows] >= degree
        below, rows = below[:, keep], rows[keep]
        if degree == 1 or not keep.all():
            passes = plan_passes(position[:, rows], REACH[1])
        # Rotations and scales say little; opacity and colour say how much a row's light changes.
        extra = [known[name].value[rows] for name in ("opacity", "scale x", "scale y", "scale z")]
        band = np.zeros((3, 2 * degree + 1, len(rows)), np.int32)
        sums = np.zeros((3, len(rows)), np.float32)
        for k in range(2 * degree + 1):
            planes: list[np.ndarray] = []
            for plane in range(3):
                values = np.zeros(len(rows), np.float32)
                source = None if codes is None else codes.sh[degree - 1][plane * (2 * degree + 1) + k]
                others = sums[0] if plane else sums[1] + sums[2]
                mine = [sums[plane], below[plane], *extra]
                for earlier in planes:
                    mine += [earlier, np.abs(earlier)]
                if plane:
                    mine.append(others)
                if plane == 2:
                    mine.append(sums[1])
                for step in passes:
                    features = [*neighbour_features(values, step), *(part[step.rows] for part in mine)]
                    batch = port.channel(group + plane, features, None if source is None else source[step.rows])
                    band[plane, k, step.rows] = batch
                    values[step.rows] = limited(batch)
                values *= ONE
                planes.append(values)
            for plane in range(3):
                sums[plane] += np.abs(planes[plane])
        below = np.minimum(sums, np.float32(VALUE_LIMIT * ONE))
        group += 3
        yield band.reshape(6 * degree + 3, len(rows))
