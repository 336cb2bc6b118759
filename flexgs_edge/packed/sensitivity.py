"""`--bits auto`: the paper's sensitivity search finds the attributes that can do with 4 bits.

The start is 8 bits for every attribute (16 for positions). Then each attribute alone is coded at 4 bits. Its loss is
the rise of the mean squared error against the original's renders, for each bit saved. Attributes move to 4 bits in
ascending order of loss. They stop before the summed rise passes the error of a 0.3 dB modelled drop.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace

from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.scene.fields import FIELDS

HIGH, LOW, POSITION = 8, 4, 16
ALLOWED_DROP = 0.3
"""Modelled drop in dB that all attributes at 4 bits may cost together."""


@dataclass(frozen=True)
class Sensitivity:
    """The sensitivity of one attribute."""

    attribute: str  # name in `--bits`
    rise: float  # rise of the mean squared error if only this attribute goes from 8 to 4 bits
    saved_bits: float  # bits saved for each Gaussian
    moved: bool  # the attribute is coded at 4 bits

    @property
    def loss(self) -> float:
        """Rise of the error for each bit saved; attributes move in this order."""
        return self.rise / self.saved_bits


def search_bits(
    error: Callable[[BitSpec], float], sh_degree: int, sh_share: float, allowed: float
) -> tuple[BitSpec, list[Sensitivity]]:
    """Find the bits of every attribute.

    Returns the bits, and the sensitivities, least sensitive attribute first.
    """
    base = BitSpec(xyz=POSITION, dc=HIGH, scale=HIGH, rot=HIGH, opacity=HIGH, rest=HIGH)
    floor = error(base)
    measured: list[Sensitivity] = []
    for field in FIELDS:
        width = field.width(sh_degree) * (sh_share if field.name == "sh_rest" else 1.0)
        if field.name == "means" or width == 0.0:
            continue  # the method fixes positions at 16 bits; at degree 0 there are no SH to save bits on
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
