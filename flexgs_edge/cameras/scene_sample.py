"""A sample of a scene, for placing cameras: where its parts lie, and some of its Gaussians, which are drawn.

All positions are relative to the source's origin.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from flexgs_edge.cameras.detail import few_rows, smears, things
from flexgs_edge.constants import SH_C1, SH_C2, SH_C3
from flexgs_edge.small_matrices import rotation_matrix

SAMPLE_ROWS = 1 << 15  # Rows for parts and ground
READ_ROWS = 1 << 23  # Most rows that are compared with those around them. Of more, every k-th is.
CHUNK_ROWS = 1 << 18  # Rows that are read together
DRAWN_ROWS = 1 << 15  # Rows that are drawn, about
THING_ROWS = 1 << 10  # About so many rows of a thing are drawn at least, if there are several and it has as many
TELLING_ROWS = 1200  # Rows whose SH tell directions
BOX_REACH = 20.0  # Beyond so many half sides of the box of the first part, nothing is told apart
BULK = (0.05, 0.95)  # Quantiles of the positions for the middle and the box of a part
OWN_SIZE = 2.0  # The box of a part reaches so many usual deviations beyond its positions: a single splat has a box too
SMALLER = 0.5
"""The core is the half of the matter that is nearest to the middle, if its box is smaller than this share of the whole."""
RESTS = 3  # So often we look for a cluster in what remains outside a core
APART = 3.0  # A cluster is a part of its own if it is so many times farther from all others than their extents together
PRECISION = 1e-5  # Smallest half side of a box over its distance from the origin: float32 positions have 7 digits
SH_FLOOR = 0.01  # Rows with a weaker view-dependent colour, on average, do not tell directions
OPAQUE = 0.5
"""Where all opacities are less, they are raised until the largest is this: faint scenes are to be seen, too."""


class Gaussians(Protocol):
    """The part of a scene source that this module needs."""

    name: str
    count: int
    sh_degree: int
    origin: np.ndarray

    def read(self, rows: slice | np.ndarray, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Read some rows: {field: [width, n] f32}."""


@dataclass(frozen=True)
class Part:
    """The box of some of the Gaussians: all of them, a dense core, or a cluster apart."""

    middle: np.ndarray  # [3] f64, opacity-weighted median
    half: np.ndarray  # [3] f64, half the sides of the box from the 5 % to the 95 % quantile, and some deviations more

    @property
    def extent(self) -> float:
        """Half the diagonal of the box, scene units."""
        return float(np.sqrt((self.half * self.half).sum()))


@dataclass(frozen=True)
class Splats:
    """A sample of rows."""

    means: np.ndarray  # [3, n] f64
    opacity: np.ndarray  # [n] f64
    deviations: np.ndarray  # [3, n] f64, along the splat's axes
    turns: np.ndarray  # [3, 3, n] f64, columns are the splat's axes

    @staticmethod
    def read(source: Gaussians, rows: np.ndarray) -> Splats:
        """Read `rows` of a scene."""
        planes = source.read(rows, ["means", "opacity_logits", "log_scales", "quats"])
        opacity, deviations = _opacities(planes), np.exp(_logs(planes))
        return Splats(planes["means"].astype(np.float64), opacity, deviations, rotations(planes["quats"]))

    @property
    def sizes(self) -> np.ndarray:
        """[n] f64, geometric mean of the two largest deviations."""
        return _sizes(self.deviations)


@dataclass(frozen=True)
class SceneSample:
    """A scene in small."""

    parts: list[Part]  # Boxes that cameras may stand in and around. The first is that of the whole scene.
    sample: Splats  # Every k-th row, at most SAMPLE_ROWS
    area: float  # Cross-sections of all rows together, scene units squared
    unit: float  # Scene units of one unit of `planes`
    planes: dict[str, np.ndarray]  # What is drawn, {field: [width, M] f32}, without view-dependent colour
    means: np.ndarray  # [3, M] f64, where they are, scene units
    sizes: np.ndarray  # [M] f64, geometric mean of the two largest deviations, before they grew to stand for others
    smear: np.ndarray  # [M] f64, see `smears`
    stands: np.ndarray  # [M] f64, for how many rows of the scene each stands
    thing: np.ndarray  # [M] int64, the number of the thing that each is of, see `things`
    things: list[Part]  # Boxes of the things, if there are several
    telling: np.ndarray  # [T] int64, those of them whose SH tell from where they were trained
    sh: np.ndarray  # [3, K, T] f64, coefficients of degrees 1 to 3 over their root mean square over all directions
    share: float  # Share of the rows that tell directions

    @property
    def whole(self) -> Part:
        """The box of the whole scene."""
        return self.parts[0]

    def agreement(self, eye: np.ndarray) -> np.ndarray:
        """[T] f64, view-dependent colour of the telling rows towards `eye` over its mean over all directions."""
        lines = self.means[:, self.telling] - eye[:, None]
        lines /= np.maximum(np.sqrt((lines * lines).sum(axis=0)), 1e-300)
        basis = sh_basis(lines, self.sh.shape[1])
        return np.minimum(np.sqrt(np.square((self.sh * basis).sum(axis=1)).sum(axis=0)), 3.0)


def sample_scene(source: Gaussians) -> SceneSample:
    """Look through a scene. Any with at least one Gaussian will do."""
    sample = Splats.read(source, np.arange(0, source.count, max(1, -(-source.count // SAMPLE_ROWS))))
    parts = find_parts(sample.means, sample.sizes, sample.opacity)
    step = max(1, -(-source.count // READ_ROWS))
    columns = []
    for start in range(0, source.count, step * CHUNK_ROWS):
        rows = slice(start, min(start + step * CHUNK_ROWS, source.count))
        planes = source.read(rows, ["means", "opacity_logits", "log_scales"])
        planes = {name: plane[:, ::step] for name, plane in planes.items()}
        columns.append((planes["means"], _sizes(np.exp(_logs(planes))), _opacities(planes)))
    means, sizes, opacity = (np.concatenate(column, axis=-1) for column in zip(*columns))
    reach = BOX_REACH * float(parts[0].half.max())
    smear, place = smears(means, sizes, parts[0].middle - reach, 2 * reach)
    areas = opacity * sizes * sizes
    thing = things(means, sizes * math.sqrt(step), parts[0].middle)
    drawn, growth = _few_of_each(areas, thing)
    # Views leave out blocks of rows that lie beside them.
    order = np.argsort(place[drawn])
    drawn, growth = drawn[order], growth[order]
    boxes = []
    for number in range(int(thing.max()) + 1 if thing.max() > 0 else 0):
        own = thing[drawn] == number
        some = drawn[own]
        boxes.append(part_of(means[:, some].astype(np.float64), sizes[some], opacity[some] * growth[own] ** 2))
    unit = min(part.extent for part in (*parts, *boxes))
    planes = source.read(drawn * step, ["means", "opacity_logits", "log_scales", "quats"])
    logs = _logs(planes) + np.log(growth * (math.sqrt(step) / unit))
    peak = float(_opacities(planes).max())
    raised = max(0.0, math.log(OPAQUE / (1 - OPAQUE)) - math.log(peak / max(1 - peak, 1e-300)))
    logits = np.clip(planes["opacity_logits"], -60, 60) + raised
    telling, sh, share = _directions(source, drawn * step)
    return SceneSample(
        parts=parts,
        sample=sample,
        area=2 * step * float(np.rint(areas / max(float(areas.max()), 1e-300) * 2.0**24).sum() * areas.max() / 2.0**24),
        unit=unit,
        planes={
            "means": np.clip(planes["means"] / unit, -1e9, 1e9).astype(np.float32),
            "opacity_logits": logits.astype(np.float32),
            "log_scales": np.clip(logs, -40, 20).astype(np.float32),
            "quats": planes["quats"],
            "sh_dc": np.zeros((3, drawn.size), np.float32),
        },
        means=means[:, drawn].astype(np.float64),
        sizes=sizes[drawn],
        smear=smear[drawn],
        stands=step * growth * growth,
        thing=thing[drawn],
        things=boxes,
        telling=telling,
        sh=sh,
        share=share,
    )


def _few_of_each(areas: np.ndarray, thing: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`few_rows` of each thing by itself, so that none is left out; crumbs go with the first."""
    if thing.max() <= 0:
        return few_rows(areas, DRAWN_ROWS)
    found = []
    for number in range(int(thing.max()) + 1):
        own = np.flatnonzero(thing == number if number else thing <= 0)
        rows, growth = few_rows(areas[own], max(DRAWN_ROWS * own.size // areas.size, THING_ROWS))
        found.append((own[rows], growth))
    rows, growth = (np.concatenate(values) for values in zip(*found))
    order = np.argsort(rows)
    return rows[order], growth[order]


def _logs(planes: dict[str, np.ndarray]) -> np.ndarray:
    # Clipped well inside float64's exponents, so that squares and products stay finite.
    return np.clip(planes["log_scales"].astype(np.float64), -40, 40)


def _opacities(planes: dict[str, np.ndarray]) -> np.ndarray:
    return 1 / (1 + np.exp(-np.clip(planes["opacity_logits"][0].astype(np.float64), -60, 40)))


def _sizes(deviations: np.ndarray) -> np.ndarray:
    a, b, c = deviations
    least = np.minimum(np.minimum(a, b), c)
    return np.sqrt(a / least * b * c)


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
    """[3, 3, n] f64, rotation matrices of quaternions w x y z ([4, n], any norm but zero). Columns are the splat's axes."""
    return rotation_matrix(quats / np.linalg.norm(quats.astype(np.float64), axis=0))


def _directions(source: Gaussians, drawn: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Which of some drawn rows tell directions, their SH above degree 0 over their root mean square, and their share."""
    used = min(source.sh_degree, 3)
    kept = (used + 1) ** 2 - 1
    if not kept:
        return np.zeros(0, np.int64), np.zeros((3, 0, 0)), 0.0
    some = np.arange(0, drawn.size, max(1, -(-drawn.size // TELLING_ROWS)))
    rest = source.read(drawn[some], ["sh_rest"])["sh_rest"].astype(np.float64).reshape(3, -1, some.size)[:, :kept]
    strength = np.sqrt(np.square(rest).sum(axis=(0, 1)) / (4 * math.pi))
    told = strength > SH_FLOOR
    return some[told], (rest / (strength + SH_FLOOR / 10))[:, :, told], float(told.mean())


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
