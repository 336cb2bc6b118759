"""What the bits of values cost in a descent, so that it also moves values to where they take fewer.

Values of a kind are taken as Laplace distributed. A value that is x away from the centre of its kind then takes
|x| / (b ln 2) bits more than one in the centre, where b is the mean of |x|. The coder knows more of a value than this, but
centres from neighbours, which it also has, gain nothing: docs/results/tuning.md#bit_weight
"""

from __future__ import annotations

import math

import numpy as np

from flexgs_edge.grid.step_sizes import Planes, StepSizes

PRICES = 33
"""Values of the record that the kernel `price_bits` takes."""
BIT_WEIGHT = 3.3
"""Weight of bits in the loss. It is above 1, since most Gaussians are not shown in all poses, and steps move only those that are
shown: docs/results/tuning.md#bit_weight"""
WIDTH = 0.5
"""Prices rise over about this many grid steps around a centre. Within a step, it makes no difference to the bits."""


def bit_prices(planes: Planes, degrees: np.ndarray, steps: StepSizes, worth: float) -> np.ndarray:
    """The record of the kernel `price_bits`.

    Parameters
    ----------
    planes : mapping
        {field: [width, n] f32}, with n above 0, before the descent. Quaternions have their canonical form.
    degrees : np.ndarray
        [n] u8, SH degree kept for each row.
    steps : StepSizes
        Of the grid that the values will be put on.
    worth : float
        Squared error in one pose that a bit is worth.

    Returns
    -------
    np.ndarray
        [33] f32: price and width of scale, rotation and opacity, and of luma and chroma of the constant and each SH degree;
        then centres of the three scales, opacity, Y, Co and Cg.
    """
    prices = np.zeros(PRICES, np.float32)
    scales, logits = planes["log_scales"].astype(np.float64), planes["opacity_logits"].astype(np.float64)
    constant = _luma_and_chroma(planes["sh_dc"])
    centres = [np.median(values, axis=1, keepdims=True) for values in (scales, logits, constant)]
    prices[26:] = np.concatenate(centres)[:, 0]

    def put(place: int, away: np.ndarray, step: float) -> None:
        # Where all values are alike they take no bits, and a small b must not make a large price of it.
        spread = max(float(np.abs(away).mean()) if away.size else 0.0, step / 4)
        prices[place : place + 2] = BIT_WEIGHT * worth / (math.log(2) * spread), WIDTH * step

    put(0, scales - centres[0], steps.scale)
    put(2, planes["quats"][1:].astype(np.float64), steps.rotation)
    put(4, logits - centres[1], steps.opacity)
    rest = planes["sh_rest"].reshape(3, -1, len(degrees))
    for level, luma in enumerate((steps.dc, *steps.sh)):
        band = rest[:, level * level - 1 : (level + 1) ** 2 - 1, degrees >= level] if level else None
        away = constant - centres[2] if band is None else _luma_and_chroma(band)
        sizes = steps.colour(luma)
        put(6 + 4 * level, away[:1], float(sizes[0]))
        put(8 + 4 * level, away[1:], float(sizes[1]))
    return prices


def _luma_and_chroma(colours: np.ndarray) -> np.ndarray:
    """Y, Co and Cg ([3, ...] f64) of red, green and blue."""
    red, green, blue = colours.astype(np.float64)
    return np.stack([(red + 2 * green + blue) / 4, red - blue, green - (red + blue) / 2])
