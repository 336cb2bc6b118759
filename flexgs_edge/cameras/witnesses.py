"""A scene in small, for placing cameras: where its parts lie, a grid of matter, and a sample of rows to be seen.

All positions are relative to the source's origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from flexgs_edge.cameras.matter import Matter, spread_matter
from flexgs_edge.constants import SH_C1, SH_C2, SH_C3

SAMPLE_ROWS = 1 << 15
"""Rows for parts, grid and ground."""
WITNESSES = 1200
"""Rows that judge candidates (the witnesses)."""
BOX = (0.01, 0.99)
"""Quantiles of the positions that the grid spans."""
BOX_REACH = 20.0
"""The grid ends at so many half sides of the box of the first part."""
BULK = (0.05, 0.95)
"""Quantiles of the positions for the middle and the box of a part."""
OWN_SIZE = 2.0
"""The box of a part reaches so many usual deviations beyond its positions: a single splat has a box too."""
SMALLER = 0.5
"""The core is the half of the matter that is nearest to the middle, if its box is smaller than this share of the whole."""
RESTS = 3
"""So often we look for a cluster in what remains outside a core."""
APART = 3.0
"""A cluster is a part of its own if it is so many times farther from all others than their extents together."""
PRECISION = 1e-5
"""Smallest half side of a box over its distance from the origin: float32 positions have 7 digits."""
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


@dataclass(frozen=True)
class Part:
    """The box of some of the Gaussians: all of them, a dense core, or a cluster apart.

    Attributes
    ----------
    middle : np.ndarray
        [3] f64, opacity-weighted median.
    half : np.ndarray
        [3] f64, half the sides of the box from the 5 % to the 95 % quantile, and some deviations more.
    """

    middle: np.ndarray
    half: np.ndarray

    @property
    def extent(self) -> float:
        """Half the diagonal of the box, scene units."""
        return float(np.sqrt((self.half * self.half).sum()))


@dataclass(frozen=True)
class Witnesses:
    """A scene in small.

    Attributes
    ----------
    parts : list of Part
        Boxes that cameras may stand in and around. The first is that of the whole scene.
    matter : Matter
        Optical density on a grid.
    sample : Splats
        Every k-th row, at most SAMPLE_ROWS.
    share : float
        Rows of the scene that a witness stands for.
    means : np.ndarray
        [3, M] f64.
    weights : np.ndarray
        [M] f64, opacities.
    sizes : np.ndarray
        [M] f64, geometric mean of the two largest deviations.
    faces : np.ndarray
        [3, 3, M] f64, the splat's axes (columns), each times the two deviations across it.
    skin : np.ndarray
        [M] f64, what belongs to the witness' own surface, scene units.
    sh : np.ndarray
        [3, K, M] f64, coefficients of degrees 1 to 3 over their root mean square over all directions.
    tells : np.ndarray
        [M] bool, rows whose SH tell from where they were trained.
    """

    parts: list[Part]
    matter: Matter
    sample: Splats
    share: float
    means: np.ndarray
    weights: np.ndarray
    sizes: np.ndarray
    faces: np.ndarray
    skin: np.ndarray
    sh: np.ndarray
    tells: np.ndarray

    @property
    def whole(self) -> Part:
        """The box of the whole scene."""
        return self.parts[0]

    def thinned(self, step: int) -> Witnesses:
        """A copy with every `step`-th witness."""
        part = slice(None, None, step)
        return replace(
            self,
            share=self.share * self.weights.size / max(1, self.weights[part].size),
            means=self.means[:, part],
            weights=self.weights[part],
            sizes=self.sizes[part],
            faces=self.faces[:, :, part],
            skin=self.skin[part],
            sh=self.sh[:, :, part],
            tells=self.tells[part],
        )

    def areas(self, lines: np.ndarray) -> np.ndarray:
        """[P, M] f64, what each witness covers across `lines` ([3, P, M], unit vectors), in deviations squared."""
        total = np.zeros(lines.shape[1:])
        for axis in range(3):
            x, y, z = self.faces[:, axis]
            total += (lines[0] * x + lines[1] * y + lines[2] * z) ** 2
        areas: np.ndarray = np.sqrt(total)
        return areas

    def transmittance(self, eyes: np.ndarray) -> np.ndarray:
        """[P, M] f64, the share of light from each witness that reaches `eyes` ([3, P])."""
        return self.matter.transmittance(eyes, self.means, self.skin)

    def agreement(self, eye: np.ndarray) -> np.ndarray:
        """[M] f64, view-dependent colour towards `eye` over its mean over all directions.

        It is 1 for rows that do not tell directions.
        """
        if not self.tells.any():
            return np.ones(self.weights.size)
        lines = self.means - eye[:, None]
        lines /= np.maximum(np.sqrt((lines * lines).sum(axis=0)), 1e-300)
        basis = sh_basis(lines, self.sh.shape[1])
        strength = np.sqrt(np.square((self.sh * basis).sum(axis=1)).sum(axis=0))
        return np.where(self.tells, np.minimum(strength, 3.0), 1.0)


@dataclass(frozen=True)
class Splats:
    """A sample of rows.

    Attributes
    ----------
    means : np.ndarray
        [3, n] f64.
    opacity : np.ndarray
        [n] f64.
    deviations : np.ndarray
        [3, n] f64, along the splat's axes.
    turns : np.ndarray
        [3, 3, n] f64, columns are the splat's axes.
    """

    means: np.ndarray
    opacity: np.ndarray
    deviations: np.ndarray
    turns: np.ndarray

    @staticmethod
    def read(source: Gaussians, rows: np.ndarray) -> Splats:
        """Read `rows` of a scene."""
        planes = source.read(rows, ["means", "opacity_logits", "log_scales", "quats"])
        logits = np.clip(planes["opacity_logits"][0].astype(np.float64), -40, 40)
        # Clipped well inside float64's exponents, so that squares and products stay finite.
        deviations = np.exp(np.clip(planes["log_scales"].astype(np.float64), -40, 40))
        opacity = 1 / (1 + np.exp(-logits))
        return Splats(planes["means"].astype(np.float64), opacity, deviations, rotations(planes["quats"]))

    @property
    def sizes(self) -> np.ndarray:
        """[n] f64, geometric mean of the two largest deviations."""
        ordered = np.sort(self.deviations, axis=0)
        sizes: np.ndarray = np.sqrt(ordered[1] * ordered[2])
        return sizes


def gather_witnesses(source: Gaussians) -> Witnesses:
    """Read a sample of a scene: every k-th row. Any scene with at least one Gaussian will do."""
    rows = np.arange(0, source.count, max(1, -(-source.count // SAMPLE_ROWS)))
    sample = Splats.read(source, rows)
    sizes = sample.sizes
    parts = find_parts(sample.means, sizes, sample.opacity)
    near = _nearest_half(sample.means, sample.opacity, parts[0].middle)
    core = part_of(sample.means[:, near], sizes[near], sample.opacity[near])
    matter = spread_matter(
        sample.means,
        sample.turns * sample.deviations,
        sample.opacity * (source.count / rows.size),
        _grid_box(sample, parts[0]),
        (core.middle, core.extent),
    )
    picked = np.arange(0, rows.size, max(1, -(-rows.size // WITNESSES)))
    sh, tells = _directions(source, rows[picked])
    means = sample.means[:, picked]
    a, b, c = sample.deviations[:, picked]
    faces = sample.turns[:, :, picked] * np.stack([b * c, a * c, a * b])
    return Witnesses(
        parts, matter, sample, source.count / picked.size,
        means, sample.opacity[picked], sizes[picked], faces, matter.skin(means), sh, tells,
    )  # fmt: skip


def find_parts(means: np.ndarray, sizes: np.ndarray, weights: np.ndarray) -> list[Part]:
    """The whole scene, its core if that is much smaller, then clusters far apart.

    A trained scene often has a dense middle, which cameras went around, and a thin background that reaches far. A box
    of the whole does not show where the middle is.
    """
    whole = part_of(means, sizes, weights)
    parts, chosen = [whole], np.arange(weights.size)
    for turn in range(1 + RESTS):
        part = part_of(means[:, chosen], sizes[chosen], weights[chosen])
        near = _nearest_half(means[:, chosen], weights[chosen], part.middle)
        half = chosen[near]
        for box in (part, part_of(means[:, half], sizes[half], weights[half])):
            if box.extent < SMALLER * whole.extent and (turn == 0 or all(_apart(box, other) for other in parts[1:])):
                parts.append(box)
                break
        chosen = chosen[~near]
        if not chosen.size:
            break
    return parts


def _apart(one: Part, other: Part) -> bool:
    away = one.middle - other.middle
    return math.sqrt(float((away * away).sum())) > APART * (one.extent + other.extent)


def part_of(means: np.ndarray, sizes: np.ndarray, weights: np.ndarray) -> Part:
    """The box of some Gaussians: `means` [3, n], `sizes` and `weights` [n]."""
    low, middle, high = weighted_quantiles(means, weights, (BULK[0], 0.5, BULK[1]))
    half = (high - low) / 2 + OWN_SIZE * float(weighted_quantiles(sizes[None], weights, (0.5,))[0, 0])
    least = max(0.05 * float(half.max()), PRECISION * float(np.abs(middle).max()))
    return Part(middle, np.maximum(half, least))


def _nearest_half(means: np.ndarray, weights: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """[n] bool, the Gaussians nearest to the middle that have half the weight."""
    away = means - middle[:, None]
    order = np.argsort((away * away).sum(axis=0), kind="stable")
    total = np.cumsum(weights[order])
    near = np.zeros(weights.size, bool)
    near[order[: int(np.searchsorted(total, 0.5 * total[-1])) + 1]] = True
    return near


def _grid_box(sample: Splats, whole: Part) -> tuple[np.ndarray, np.ndarray]:
    low, high = weighted_quantiles(sample.means, np.ones(sample.opacity.size), BOX)
    low, high = np.minimum(low, whole.middle - whole.half), np.maximum(high, whole.middle + whole.half)
    reach = BOX_REACH * float(whole.half.max())
    return np.maximum(low, whole.middle - reach), np.minimum(high, whole.middle + reach)


def weighted_quantiles(values: np.ndarray, weights: np.ndarray, shares: Sequence[float]) -> np.ndarray:
    """[len(shares), c], quantiles of each row of `values` ([c, n]) with `weights` ([n])."""
    order = np.argsort(values, axis=1, kind="stable")
    result = np.empty((len(shares), len(values)))
    for row, (places, line) in enumerate(zip(order, values)):
        total = np.cumsum(weights[places])
        at = np.searchsorted(total, np.asarray(shares) * total[-1])
        result[:, row] = line[places[np.minimum(at, len(places) - 1)]]
    return result


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
