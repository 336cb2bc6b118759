"""Code positions as an octree: one byte a node tells which of its children are occupied, level by level from the root."""

from collections.abc import Callable

import numpy as np

from flexgs_edge.constants import CHILD_CLASSES, LEVEL_CLASSES
from flexgs_edge.grid.step_sizes import POSITION_BITS

CONTEXTS = LEVEL_CLASSES * CHILD_CLASSES

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
