"""A scene in small, for placing cameras: its robust middle and extent, a grid of matter, and a sample of rows to be seen.

All positions are relative to the source's origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flexgs_edge.constants import SH_C1, SH_C2, SH_C3
from flexgs_edge.errors import InputError

SAMPLE_ROWS = 1 << 16
"""Rows for middle, extent and grid."""
WITNESSES = 1500
"""Rows that judge candidates (the witnesses)."""
GRID = 40
"""Cells of the matter grid along its longest side."""
BOX = (0.01, 0.99)
"""Quantiles of the positions that the grid spans."""
BULK = (0.05, 0.95)
"""Quantiles of the positions for middle and extent."""
MARCH = 24
"""Steps of a line of sight through the grid."""
SPREAD_POINTS = 16
"""Points over which the matter of a splat is spread if it is wider than a cell."""
SKIN = 3.0
"""Cells at the end of a line of sight that belong to the surface it looks at."""
SH_FLOOR = 0.01
"""Rows with a weaker view-dependent colour, on average, do not tell directions."""


class Gaussians(Protocol):
    """The part of a scene source that this module needs."""

    name: str
    count: int
    sh_degree: int
    origin: np.ndarray

    def read(self, rows: np.ndarray, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Read some rows: {field: [width, n] f32}."""


@dataclass
class Witnesses:
    """A scene in small.

    Attributes
    ----------
    middle : np.ndarray
        [3] f64, opacity-weighted median.
    half : np.ndarray
        [3] f64, half the sides of the box from the 5 % to the 95 % quantile.
    corner, cell : np.ndarray, float
        [3] f64 first corner and side of the grid's cells.
    depth : np.ndarray
        [x + 2, y + 2, z + 2] f64, optical depth of a cell along its side; a rim of empty cells.
    smooth : np.ndarray
        [-1] f64, `depth` averaged over 3 cells each way: lines of sight in steps of some cells do not miss thin walls.
    means : np.ndarray
        [3, M] f64.
    weights : np.ndarray
        [M] f64, opacities.
    sizes : np.ndarray
        [M] f64, geometric mean of the two largest deviations.
    sh : np.ndarray
        [3, K, M] f64, coefficients of degrees 1 to 3 over their root mean square over all directions.
    tells : np.ndarray
        [M] bool, rows whose SH tell from where they were trained.
    """

    middle: np.ndarray
    half: np.ndarray
    corner: np.ndarray
    cell: float
    depth: np.ndarray
    smooth: np.ndarray
    means: np.ndarray
    weights: np.ndarray
    sizes: np.ndarray
    sh: np.ndarray
    tells: np.ndarray

    @property
    def extent(self) -> float:
        """Half the diagonal of the box, scene units."""
        return float(np.linalg.norm(self.half))

    def thinned(self, step: int) -> Witnesses:
        """A copy with every `step`-th witness."""
        part = slice(None, None, step)
        return replace(
            self,
            means=self.means[:, part],
            weights=self.weights[part],
            sizes=self.sizes[part],
            sh=self.sh[:, :, part],
            tells=self.tells[part],
        )

    def optical_depth(self, points: np.ndarray) -> np.ndarray:
        """[n] f64, optical depth of the cells at `points` ([3, n]); 0 outside the grid."""
        places = (points - self.corner[:, None]) / self.cell + 1
        x, y, z = (np.clip(line, 0, n - 1).astype(np.int64) for line, n in zip(places, self.depth.shape))
        found: np.ndarray = self.depth[x, y, z]
        return found

    def transmittance(self, eye: np.ndarray, ends: np.ndarray) -> np.ndarray:
        """[n] f64, the share of light from `ends` ([3, n]) that reaches `eye` ([3])."""
        shape = np.array(self.depth.shape)
        start = (eye - self.corner) / self.cell + 1
        lines = (ends - eye[:, None]) / self.cell
        length = np.linalg.norm(lines, axis=0)
        # From the point where the line enters the grid to where it leaves it, or to the surface it looks at.
        with np.errstate(divide="ignore", invalid="ignore"):
            sides = np.stack([-start[:, None] / lines, (shape - start)[:, None] / lines])
        sides = np.where(np.isnan(sides), 0.0, sides)
        first = np.clip(sides.min(axis=0).max(axis=0), 0.0, 1.0)
        last = np.minimum(sides.max(axis=0).min(axis=0), 1 - SKIN / np.maximum(length, SKIN))
        inside = np.maximum(last - first, 0.0)
        steps = first + inside * ((np.arange(MARCH) + 0.5) / MARCH)[:, None]
        x, y, z = (np.floor(begin + line * steps).astype(np.int64) for begin, line in zip(start, lines))
        cells = np.take(self.smooth, (x * shape[1] + y) * shape[2] + z, mode="clip")
        clear: np.ndarray = np.exp(-cells.mean(axis=0) * inside * length)
        return clear

    def agreement(self, eye: np.ndarray) -> np.ndarray:
        """[M] f64, view-dependent colour towards `eye` over its mean over all directions.

        It is 1 for rows that do not tell directions.
        """
        lines = self.means - eye[:, None]
        lines /= np.maximum(np.linalg.norm(lines, axis=0), 1e-12)
        basis = sh_basis(lines, self.sh.shape[1])
        strength = np.sqrt(np.square(np.einsum("ckm,km->cm", self.sh, basis)).sum(axis=0))
        return np.where(self.tells, np.minimum(strength, 3.0), 1.0)


def gather_witnesses(source: Gaussians) -> Witnesses:
    """Read a sample of a scene (every k-th row, at most 65536).

    Raises
    ------
    InputError
        If the Gaussians have no extent.
    """
    rows = np.arange(0, source.count, max(1, -(-source.count // SAMPLE_ROWS)))
    sample = source.read(rows, ["means", "opacity_logits", "log_scales", "quats"])
    means = sample["means"].astype(np.float64)
    opacity = 1 / (1 + np.exp(-sample["opacity_logits"][0].astype(np.float64)))
    # Clipped well inside float64's exponents, so that squares and products stay finite.
    deviations = np.exp(np.sort(np.clip(sample["log_scales"].astype(np.float64), -40, 40), axis=0))
    sizes = np.sqrt(deviations[1] * deviations[2])
    low, middle, high = weighted_quantiles(means, opacity, (BULK[0], 0.5, BULK[1]))
    half = (high - low) / 2
    floor = max(float(half.max()), float(np.median(sizes)))
    if not floor > 0:
        raise InputError(f"{source.name}: automatic cameras: the Gaussians have no extent; give cameras")
    corner, cell, depth = _grid(sample, opacity, deviations, source.count / rows.size)
    picked = np.arange(0, rows.size, max(1, -(-rows.size // WITNESSES)))
    sh, tells = _directions(source, rows[picked])
    return Witnesses(
        middle, np.maximum(half, 0.05 * floor), corner, cell, depth, _smooth(depth),
        means[:, picked], opacity[picked], sizes[picked], sh, tells,
    )  # fmt: skip


def weighted_quantiles(values: np.ndarray, weights: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """[len(shares), c], quantiles of each row of `values` ([c, n]) with `weights` ([n])."""
    order = np.argsort(values, axis=1, kind="stable")
    result = np.empty((len(shares), len(values)))
    for row, (places, line) in enumerate(zip(order, values)):
        total = np.cumsum(weights[places])
        at = np.searchsorted(total, np.asarray(shares) * total[-1])
        result[:, row] = line[places[np.minimum(at, len(places) - 1)]]
    return result


def _grid(
    sample: dict[str, np.ndarray], opacity: np.ndarray, deviations: np.ndarray, share: float
) -> tuple[np.ndarray, float, np.ndarray]:
    """First corner, cell side, and optical depth of each cell along its side, with a rim of empty cells.

    The matter of a splat is its opacity times its mean cross-section. If a splat is wider than a cell, its matter is
    spread over points drawn from it. It is cut if even these would fill more than a cell each. Each row stands for
    `share` rows.
    """
    means = sample["means"].astype(np.float64)
    low, high = np.quantile(means, BOX, axis=1)
    cell = max(float((high - low).max()) / GRID, 1e-9 * float(np.abs(means).max()), 1e-30)
    shape = np.floor((high - low) / cell).astype(np.int64) + 2
    low = low - cell / 2
    a, b, c = deviations
    matter = opacity * 2 * math.pi / 3 * (a * b + b * c + a * c) * share / (cell * cell)
    wide = c > cell
    depth = np.zeros(tuple(int(n) for n in shape))

    def add(points: np.ndarray, amounts: np.ndarray) -> None:
        index = np.floor((points - low[:, None]) / cell).astype(np.int64)
        inside = ((index >= 0) & (index < shape[:, None])).all(axis=0)
        np.add.at(depth, tuple(index[:, inside]), amounts[inside])

    add(means[:, ~wide], matter[~wide])
    axes = rotations(sample["quats"][:, wide]) * np.exp(
        np.clip(sample["log_scales"][:, wide].astype(np.float64), -40, 40)
    )
    part = np.minimum(matter[wide] / SPREAD_POINTS, opacity[wide] * share)
    for offset in np.random.default_rng(0).normal(size=(SPREAD_POINTS, 3)):
        add(means[:, wide] + np.einsum("xyn,y->xn", axes, offset), part)
    return low, cell, np.pad(depth, 1)


def rotations(quats: np.ndarray) -> np.ndarray:
    """[3, 3, n] f64, rotation matrices of quaternions w x y z ([4, n], any norm but zero).

    Columns are the splat's axes.
    """
    w, x, y, z = quats / np.linalg.norm(quats.astype(np.float64), axis=0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _smooth(depth: np.ndarray) -> np.ndarray:
    """[-1] f64, the mean over 3 cells along each axis; the rim is empty, so that nothing wraps around."""
    for axis in range(3):
        depth = (np.roll(depth, 1, axis) + depth + np.roll(depth, -1, axis)) / 3
    return depth.reshape(-1)


def _directions(source: Gaussians, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """SH above degree 0 over their root mean square, and the rows that are strong enough to tell directions."""
    used = min(source.sh_degree, 3)
    kept = (used + 1) ** 2 - 1
    if not kept:
        return np.zeros((3, 0, rows.size)), np.zeros(rows.size, bool)
    coefficients = source.read(rows, ["sh_rest"])["sh_rest"].astype(np.float64).reshape(3, -1, rows.size)[:, :kept]
    strength = np.sqrt(np.square(coefficients).sum(axis=(0, 1)) / (4 * math.pi))
    return coefficients / (strength + SH_FLOOR / 10), strength > SH_FLOOR


def sh_basis(directions: np.ndarray, count: int) -> np.ndarray:
    """[count, n], the first `count` (3, 8 or 15) SH functions above degree 0 in unit `directions` ([3, n])."""
    if not count:
        return np.zeros((0, directions.shape[1]))
    x, y, z = directions
    xx, yy, zz = x * x, y * y, z * z
    terms = [-SH_C1 * y, SH_C1 * z, -SH_C1 * x]
    if count > 3:
        terms += [
            SH_C2[0] * x * y, SH_C2[1] * y * z, SH_C2[2] * (2 * zz - xx - yy), SH_C2[3] * x * z, SH_C2[4] * (xx - yy),
        ]  # fmt: skip
    if count > 8:
        terms += [
            SH_C3[0] * y * (3 * xx - yy), SH_C3[1] * x * y * z, SH_C3[2] * y * (4 * zz - xx - yy),
            SH_C3[3] * z * (2 * zz - 3 * xx - 3 * yy), SH_C3[4] * x * (4 * zz - xx - yy), SH_C3[5] * z * (xx - yy),
            SH_C3[6] * x * (xx - 3 * yy),
        ]  # fmt: skip
    return np.array(terms)
