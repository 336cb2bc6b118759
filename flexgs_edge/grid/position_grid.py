"""Choose how positions are put on a grid: the step size, and a contraction if some lie too far away for it."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import CODE_LIMIT
from flexgs_edge.grid.step_sizes import POSITION_BITS
from flexgs_edge.memory.rows import COPY_ROWS, blocks, read_rows
from flexgs_edge.scene.contraction import OCTAVES, Contraction, densest

_HALF = 2 ** (POSITION_BITS - 1) - 2  # Steps from the centre of a grid to its ends
_LEAST_RADIUS = _HALF.bit_length() - OCTAVES.bit_length()
"""Binary logarithm of the smallest radius, in steps: all octaves then fit."""


def position_grid(means: np.ndarray, step: float) -> tuple[float, Contraction | None]:
    """The step size to take for positions, and their contraction.

    Where the grid is too small for the scene, positions beyond a radius are contracted. The radius is the largest for which all
    fit, so that as many positions as possible stay as they are.

    `means`: [3, n] f32, finite. `step`: step size as wanted.
    """
    ranges = np.array(plane_ranges(means), np.float64)
    if not len(ranges) or np.ptp(ranges, axis=1).max() <= (2**POSITION_BITS - 2) * step:
        return max(step, float(np.abs(ranges).max(initial=0)) / (CODE_LIMIT - 2)), None
    centre = densest(means)
    reach = float(np.abs(ranges - centre[:, None]).max())
    step = max(
        step, float(np.abs(centre).max()) / (CODE_LIMIT - 2 * _HALF), reach * 2.0 ** -(OCTAVES - 2 + _LEAST_RADIUS)
    )
    for power in range(POSITION_BITS - 1, _LEAST_RADIUS - 1, -1):
        contraction = Contraction((float(centre[0]), float(centre[1]), float(centre[2])), step * 2.0**power)
        farthest = contraction.contract(centre[:, None] + [[reach], [0.0], [0.0]])[0, 0] - centre[0]
        if farthest <= _HALF * step:
            break
    return step, contraction


def plane_ranges(planes: np.ndarray) -> list[tuple[np.float32, np.float32]]:
    """Smallest and largest value of each plane of [width, n] f32; none where n is 0."""
    ranges = []
    for plane in planes if planes.shape[1] else ():
        low, high = plane[0], plane[0]
        for rows in blocks(len(plane), COPY_ROWS):
            part = read_rows(plane, rows)
            low, high = min(low, part.min()), max(high, part.max())
        ranges.append((low, high))
    return ranges
