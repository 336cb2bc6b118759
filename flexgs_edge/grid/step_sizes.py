"""Step sizes of a grid: one for each kind of value, and one for each SH degree."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flexgs_edge.constants import CODE_LIMIT, MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.memory.rows import COPY_ROWS, blocks, read_rows
from flexgs_edge.scene.contraction import OCTAVES, Contraction, densest

POSITION_BITS = 21  # A scene is at most 2^21 cells wide on each axis; three coordinates fill a Morton index of 63 bits

Planes = Mapping[str, np.ndarray]
_HALF = 2 ** (POSITION_BITS - 1) - 2  # Steps from the centre of a grid to its ends
_LEAST_RADIUS = _HALF.bit_length() - OCTAVES.bit_length()
"""Binary logarithm of the smallest radius, in steps: all octaves then fit."""


@dataclass(frozen=True)
class StepSizes:
    """Step sizes of a grid; each is rounded to float32 once."""

    position: float  # in scene units
    scale: float  # of the natural logarithm of a scale
    rotation: float  # of x, y and z of a unit quaternion
    opacity: float  # of the logit
    dc: float  # of the luma of the SH coefficient of degree 0
    sh: tuple[float, ...] = ()  # of the luma of SH coefficients, one for each degree from 1
    chroma: float = 1.5  # factor by which the steps of the two chroma planes are larger
    contraction: Contraction | None = None  # Of the positions that the grid holds. Default: they are not contracted.

    def __post_init__(self) -> None:
        for name, value in self._numbers().items():
            numbers = value if name == "sh" else (value,)
            with np.errstate(over="ignore"):  # a file may contain 1e300
                rounded = tuple(float(np.float32(number)) for number in numbers)
            # Beyond these bounds, 24-bit codes times a step times the chroma factor leave float32's normal numbers.
            most = 16 if name == "chroma" else 80
            if not all(2.0**-most <= number <= 2.0**most for number in rounded):
                raise InputError(f"step of {name}: expected positive numbers from 2^-{most} to 2^{most}, got {value}")
            object.__setattr__(self, name, rounded if name == "sh" else rounded[0])
        if len(self.sh) > MAX_SH_DEGREE:
            raise InputError(f"steps of sh: expected at most {MAX_SH_DEGREE}, one a degree, got {len(self.sh)}")

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        contraction = {} if self.contraction is None else {"contraction": self.contraction.to_json()}
        return {**self._numbers(), "sh": list(self.sh), **contraction}

    def _numbers(self) -> dict[str, Any]:
        return {name: value for name, value in asdict(self).items() if name != "contraction"}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> "StepSizes":
        """Inverse of `to_json`."""
        contraction = Contraction.from_json(record["contraction"]) if "contraction" in record else None
        return cls(**{**record, "sh": tuple(record["sh"]), "contraction": contraction})

    def colour(self, luma: float) -> np.ndarray:
        """[3] f32, the steps of Y, Co and Cg, given the step of luma."""
        chroma = np.float32(luma) * np.float32(self.chroma)
        return np.array([luma, chroma, chroma], np.float32)


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


def holdable(steps: StepSizes, planes: Planes) -> StepSizes:
    """`steps`, with coarser ones where codes could not hold the planes' values, and positions contracted if they need it."""

    def finest(name: str, codes: int = CODE_LIMIT - 2) -> float:
        return max((float(max(-low, high)) for low, high in plane_ranges(planes[name])), default=0.0) / codes

    least = 2.0**-70
    position, contraction = position_grid(planes["means"], max(steps.position, least))
    colours = CODE_LIMIT // 4  # Co reaches twice the coefficients, and refits move the coefficients
    finest_sh = finest("sh_rest", colours)
    return StepSizes(
        position=position,
        scale=max(steps.scale, finest("log_scales"), least),
        rotation=max(steps.rotation, 2 / CODE_LIMIT),
        opacity=max(steps.opacity, finest("opacity_logits"), least),
        dc=max(steps.dc, finest("sh_dc", colours), least),
        sh=tuple(max(step, finest_sh, least) for step in steps.sh),
        chroma=steps.chroma,
        contraction=contraction,
    )
