"""Step sizes of a grid: one for each kind of value, and one for each SH degree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError
from flexgs_edge.scene.contraction import Contraction

POSITION_BITS = 21  # A scene is at most 2^21 cells wide on each axis; three coordinates fill a Morton index of 63 bits

Planes = Mapping[str, np.ndarray]


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
    def from_json(cls, record: Mapping[str, Any]) -> StepSizes:
        """Inverse of `to_json`."""
        contraction = Contraction.from_json(record["contraction"]) if "contraction" in record else None
        return cls(**{**record, "sh": tuple(record["sh"]), "contraction": contraction})

    def colour(self, luma: float) -> np.ndarray:
        """[3] f32, the steps of Y, Co and Cg, given the step of luma."""
        chroma = np.float32(luma) * np.float32(self.chroma)
        return np.array([luma, chroma, chroma], np.float32)
