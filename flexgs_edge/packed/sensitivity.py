"""`--bits auto`: which attributes bear 4 bits, found by the paper's sensitivity search.

Everything is coded at 8 bits (positions at 16). Each attribute alone is then coded at 4: its loss is the rise of the mean
squared error against the original's renders for each bit saved. Attributes move to 4 bits in ascending order of loss while
the summed rise stays under the error of a 0.3 dB modelled drop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.scene.fields import FIELDS

HIGH, LOW, POSITION = 8, 4, 16
ALLOWED_DROP = 0.3
"""Modelled drop in dB that the summed rises may cost."""


@dataclass(frozen=True)
class Sensitivity:
    """One attribute of the search.

    Parameters
    ----------
    attribute : str
        Name in `--bits`.
    rise : float
        Rise of the mean squared error when it alone goes from 8 to 4 bits.
    saved_bits : float
        Bits saved a Gaussian.
    moved : bool
        It is coded at 4 bits.
    """

    attribute: str
    rise: float
    saved_bits: float
    moved: bool

    @property
    def loss(self) -> float:
        """Rise for each bit saved a Gaussian: the order in which attributes move."""
        return self.rise / self.saved_bits


def search_bits(
    error: Callable[[BitSpec], float], sh_degree: int, sh_share: float, allowed: float
) -> tuple[BitSpec, list[Sensitivity]]:
    """Find the bits of every attribute.

    Parameters
    ----------
    error : callable
        Mean squared error against the original's renders when coded with these bits.
    sh_degree : int
        SH degree of the scene.
    sh_share : float
        Share of the Gaussians that have SH above degree 0.
    allowed : float
        Mean squared error of the allowed modelled drop (`render.quality.error_for_drop`).

    Returns
    -------
    tuple
        The bits, and what was measured, least sensitive first.
    """
    base = BitSpec(xyz=POSITION, dc=HIGH, scale=HIGH, rot=HIGH, opacity=HIGH, rest=HIGH)
    floor = error(base)
    measured: list[Sensitivity] = []
    for field in FIELDS:
        width = field.width(sh_degree) * (sh_share if field.name == "sh_rest" else 1.0)
        if field.name == "means" or width == 0.0:
            continue  # 16-bit positions are part of the method; at degree 0 there are no SH to save on
        rise = max(error(replace(base, **{field.bits: LOW})) - floor, 0.0)
        measured.append(Sensitivity(field.bits, rise, (HIGH - LOW) * width, moved=False))
    measured.sort(key=lambda item: (item.loss, item.attribute))
    bits, rises = asdict(base), [0.0]
    found: list[Sensitivity] = []
    for item in measured:
        fits = len(found) == sum(s.moved for s in found) and math.fsum([*rises, item.rise]) < allowed
        if fits:
            bits[item.attribute] = LOW
            rises.append(item.rise)
        found.append(replace(item, moved=fits))
    return BitSpec(**bits), found
