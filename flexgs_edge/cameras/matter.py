"""The matter of a scene on a coarse grid, for lines of sight: cells are small in its middle, and grow away from it.

Nothing here depends on the order of sums: amounts are added by row, and lines of sight are independent.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

GRID = 40
"""Cells along the side with the most of them."""
ENTRIES = 4096
"""Entries of an axis' table from a position to a cell; two more stand for outside."""
FINEST = 0.01
"""Cells stop to shrink within this share of the grid's longest side around the middle."""
MARCH = 20
"""Points of a line of sight."""
SPREAD_POINTS = 12
"""Points over which the matter of a splat is spread if it is wider than a cell."""
SKIN = 3.0
"""Cells at the end of a line of sight that belong to the surface it looks at."""
FARTHEST = 1e9
"""Points farther away, in entries of a table, are moved to here: integers must hold them."""
PAIRS = 1 << 14
"""Lines of sight that are followed together: their numbers stay in the processor's cache."""


@dataclass(frozen=True)
class Matter:
    """Optical density on a grid.

    Attributes
    ----------
    low, scale : np.ndarray
        [3] f64, first corner, and entries of the tables per scene unit.
    tables : tuple of np.ndarray
        [ENTRIES + 2] int64 each: what an entry adds to the index of its cell.
    side : np.ndarray
        [cells] f64, longest side of each cell, scene units.
    standing : np.ndarray
        [cells] f64, largest optical depth of the cell and its neighbours, along their sides.
    density : np.ndarray
        [cells] f32, optical depth per scene unit, over 3 cells each way: lines of sight do not miss thin walls.
    """

    low: np.ndarray
    scale: np.ndarray
    tables: tuple[np.ndarray, ...]
    side: np.ndarray
    standing: np.ndarray
    density: np.ndarray

    def cells(self, points: np.ndarray) -> np.ndarray:
        """[n] int64, the cells at `points` ([3, n]); all places outside the grid share its empty rim."""
        return _cells(self.tables, self._entries(points))

    def optical_depth(self, points: np.ndarray) -> np.ndarray:
        """[n] f64, the largest optical depth at and beside `points` ([3, n]) along a cell's side; 0 outside the grid."""
        depth: np.ndarray = self.standing[self.cells(points)]
        return depth

    def skin(self, points: np.ndarray) -> np.ndarray:
        """[n] f64, what belongs to the surface at `points` ([3, n]), scene units."""
        skin: np.ndarray = SKIN * self.side[self.cells(points)]
        return skin

    def transmittance(self, eyes: np.ndarray, ends: np.ndarray, skin: np.ndarray) -> np.ndarray:
        """[P, n] f64, the share of light from `ends` ([3, n]) that reaches `eyes` ([3, P]); `skin` is [n].

        `ends` may also be [3, P, n], and `skin` [P, n]: other ends for each eye.
        """
        count, width = eyes.shape[1], ends.shape[-1]
        found = np.empty((count, width))
        step = max(1, PAIRS // max(width, 1))
        each = ends.ndim == 3
        for start in range(0, count, step):
            part = slice(start, start + step)
            lines = (ends[:, part] if each else ends[:, None]) - eyes[:, part, None]
            found[part] = self._march(eyes[:, part], lines, skin[part] if each else skin)
        return found

    def _march(self, eyes: np.ndarray, lines: np.ndarray, skin: np.ndarray) -> np.ndarray:
        length = np.sqrt(lines[0] ** 2 + lines[1] ** 2 + lines[2] ** 2)
        start = self._entries(eyes)[:, :, None]
        reach = np.clip(lines * self.scale[:, None, None], -FARTHEST, FARTHEST)
        # From the point where the line enters the grid to where it leaves it, or to the surface it looks at.
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (1 - start) / reach, (ENTRIES + 1 - start) / reach
            first = np.clip(np.fmax.reduce(np.fmin(one, other)), 0.0, 1.0)
            last = np.minimum(np.fmin.reduce(np.fmax(one, other)), 1 - skin / length)
        inside = np.nan_to_num(np.maximum(last - first, 0.0))
        begin = (start + reach * first).astype(np.float32)
        reach = (reach * inside).astype(np.float32)
        total = np.zeros(length.shape, np.float32)
        for place, share in zip(*_steps()):
            total += share * np.take(self.density, _cells(self.tables, begin + reach * place))
        clear: np.ndarray = np.exp(-(total * inside * length))
        return clear

    def _entries(self, points: np.ndarray) -> np.ndarray:
        shape = (3,) + (1,) * (points.ndim - 1)
        places = (points - self.low.reshape(shape)) * self.scale.reshape(shape) + 1
        clipped: np.ndarray = np.clip(places, -FARTHEST, FARTHEST)
        return clipped


def _steps() -> tuple[np.ndarray, np.ndarray]:
    """Where points lie along a line (0 to 1), and their shares of it. They are dense at both ends, where matter counts."""
    edges = np.linspace(0, 1, MARCH + 1)
    edges = edges * edges * (3 - 2 * edges)
    return ((edges[1:] + edges[:-1]) / 2).astype(np.float32), np.diff(edges).astype(np.float32)


def _cells(tables: Sequence[np.ndarray], entries: np.ndarray) -> np.ndarray:
    """Index of the cell of each point, from its `entries` ([3, ...]); below 1 and from ENTRIES + 1 on lies the rim."""
    total: np.ndarray = np.take(tables[0], entries[0].astype(np.int64), mode="clip")
    total += np.take(tables[1], entries[1].astype(np.int64), mode="clip")
    total += np.take(tables[2], entries[2].astype(np.int64), mode="clip")
    return total


def spread_matter(
    means: np.ndarray,
    axes: np.ndarray,
    opacity: np.ndarray,
    box: tuple[np.ndarray, np.ndarray],
    focus: tuple[np.ndarray, float],
) -> Matter:
    """Put a scene's matter on a grid.

    The matter of a splat is its opacity times its mean cross-section. If a splat is wider than a cell, its matter is
    spread over points drawn from it. It is cut if even these would fill more than a cell each.

    Parameters
    ----------
    means : np.ndarray
        [3, n] f64.
    axes : np.ndarray
        [3, 3, n] f64, columns are the splats' axes times their deviations.
    opacity : np.ndarray
        [n] f64, times the number of rows that a row stands for.
    box : tuple of np.ndarray
        [3] f64 each, first and last corner of the grid.
    focus : tuple
        Where cells are smallest ([3] f64), and the distance from there at which they begin to grow.
    """
    low, high = box
    middle, core = focus
    core = max(core, FINEST * float((high - low).max()))
    begin, end = np.arcsinh((low - middle) / core), np.arcsinh((high - middle) / core)
    step = float((end - begin).max()) / GRID
    counts = [max(1, math.ceil((e - b) / step - 1e-6)) for b, e in zip(begin, end)]
    tables, sides = [], []
    stride = [(counts[1] + 2) * (counts[2] + 2), counts[2] + 2, 1]
    for axis, count in enumerate(counts):
        edges = middle[axis] + core * np.sinh(np.linspace(begin[axis], end[axis], count + 1))
        centres = low[axis] + (high[axis] - low[axis]) * (np.arange(ENTRIES) + 0.5) / ENTRIES
        cells = np.clip(np.searchsorted(edges, centres), 1, count)
        tables.append(np.concatenate([[0], cells, [0]]) * stride[axis])
        widths = np.diff(edges)
        sides.append(np.concatenate([widths[:1], widths, widths[-1:]]))
    volume = (sides[0][:, None, None] * sides[1][:, None] * sides[2]).reshape(-1)
    side = np.maximum(np.maximum(sides[0][:, None, None], sides[1][:, None]), sides[2]).reshape(-1)
    grid = Matter(low, ENTRIES / (high - low), tuple(tables), side, np.zeros(0), np.zeros(0, np.float32))
    matter = _deposit(grid, means, axes, opacity, volume)
    shape = tuple(count + 2 for count in counts)
    matter, volume = matter.reshape(shape), volume.reshape(shape)
    _clear_rim(matter)
    density, depth = _box_sum(matter) / _box_sum(volume), matter / np.cbrt(volume) ** 2
    for axis in range(3):
        depth = np.maximum(np.maximum(np.roll(depth, 1, axis), depth), np.roll(depth, -1, axis))
    for plane in (density, depth):
        _clear_rim(plane)
    return Matter(low, grid.scale, grid.tables, side, depth.reshape(-1), density.reshape(-1).astype(np.float32))


def _deposit(grid: Matter, means: np.ndarray, axes: np.ndarray, opacity: np.ndarray, volume: np.ndarray) -> np.ndarray:
    """[cells] f64, the cross-sections of all splats in each cell, scene units squared."""
    a, b, c = np.sqrt((axes * axes).sum(axis=0))
    matter = opacity * 2 * math.pi / 3 * (a * b + b * c + a * c)
    at = grid.cells(means)
    wide = np.maximum(np.maximum(a, b), c) > np.cbrt(volume[at])
    total = np.zeros(volume.size)
    total += np.bincount(at[~wide], matter[~wide], volume.size)
    means, axes, part = means[:, wide], axes[:, :, wide], matter[wide] / SPREAD_POINTS
    most = np.cbrt(volume) ** 2
    for x, y, z in np.random.default_rng(0).normal(size=(SPREAD_POINTS, 3)):
        at = grid.cells(means + axes[:, 0] * x + axes[:, 1] * y + axes[:, 2] * z)
        total += np.bincount(at, np.minimum(part, opacity[wide] * most[at]), volume.size)
    return total


def _box_sum(values: np.ndarray) -> np.ndarray:
    """Sums over 3 cells along each axis."""
    for axis in range(3):
        values = np.roll(values, 1, axis) + values + np.roll(values, -1, axis)
    return values


def _clear_rim(values: np.ndarray) -> None:
    """Set the outermost cells to zero: they stand for everything outside."""
    for axis in range(3):
        rim = np.moveaxis(values, axis, 0)
        rim[0] = rim[-1] = 0
