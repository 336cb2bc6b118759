"""Quantization step sizes: one for each kind of value, one for each degree of SH."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError

POSITION_BITS = 21
"""Cells along an axis of a scene as a power of two: three of them fill a 63-bit curve index."""

Planes = Mapping[str, np.ndarray]


@dataclass(frozen=True)
class StepSizes:
    """Grid steps, rounded to float32 once.

    Parameters
    ----------
    position : float
        Scene units.
    scale : float
        Natural logarithm.
    rotation : float
        Component x, y or z of a unit quaternion.
    opacity : float
        Logit.
    dc : float
        Luma of the SH coefficient of degree 0.
    sh : tuple of float
        Luma of SH coefficients, one step for each degree from 1.
    chroma : float, optional
        Factor of the steps of the two chroma planes.
    """

    position: float
    scale: float
    rotation: float
    opacity: float
    dc: float
    sh: tuple[float, ...] = ()
    chroma: float = 1.5

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            numbers = value if name == "sh" else (value,)
            with np.errstate(over="ignore"):  # a file may say 1e300
                rounded = tuple(float(np.float32(number)) for number in numbers)
            # Beyond this, codes of 24 bits times a step times the chroma factor leave float32's normal numbers.
            most = 16 if name == "chroma" else 80
            if not all(2.0**-most <= number <= 2.0**most for number in rounded):
                raise InputError(f"step of {name}: expected positive numbers from 2^-{most} to 2^{most}, got {value}")
            object.__setattr__(self, name, rounded if name == "sh" else rounded[0])
        if len(self.sh) > MAX_SH_DEGREE:
            raise InputError(f"steps of sh: expected at most {MAX_SH_DEGREE}, one a degree, got {len(self.sh)}")

    def to_json(self) -> dict[str, Any]:
        """The fields as JSON values."""
        return {**asdict(self), "sh": list(self.sh)}

    @classmethod
    def from_json(cls, record: Mapping[str, Any]) -> StepSizes:
        """Inverse of `to_json`."""
        return cls(**{**record, "sh": tuple(record["sh"])})

    def colour(self, luma: float) -> np.ndarray:
        """[3] f32: the steps of Y, Co and Cg for a step of luma."""
        chroma = np.float32(luma) * np.float32(self.chroma)
        return np.array([luma, chroma, chroma], np.float32)
