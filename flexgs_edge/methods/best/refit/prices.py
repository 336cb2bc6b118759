"""What the bits of values cost in a descent, so that it also moves values to where they take fewer.

Values of a kind are taken as Laplace distributed. A value that is x away from the centre of its kind then takes
|x| / (b ln 2) bits more than one in the centre, where b is the mean of |x|. The coder knows more of a value than this, but
centres from neighbours, which it also has, gain nothing: docs/results/tuning.md#bit_weight
"""

from __future__ import annotations

import math

import numpy as np

from flexgs_edge.grid.step_sizes import Planes, StepSizes
from flexgs_edge.memory.rows import read_ahead

PRICES = 33
"""Values of the record that the kernel `descend` takes."""
WIDTH = 0.5
"""Prices rise over about this many grid steps around a centre. Within a step, it makes no difference to the bits."""


def bit_prices(planes: Planes, degrees: np.ndarray, steps: StepSizes, worth: float) -> np.ndarray:
    """The record of the kernel `descend`.

    `planes`: {field: [width, n] f32}, with n above 0, before the descent. Quaternions have their canonical form.
    `degrees`: [n] u8, SH degree kept for each row. `steps`: of the grid that the values will be put on. `worth`:
    squared error in one pose that a bit costs. Returns [33] f32: price and width of scale, rotation and opacity, and of
    luma and chroma of the constant and each SH degree; then centres of the three scales, opacity, Y, Co and Cg.
    """
    centres = _centres(planes)
    grid = [steps.scale, steps.rotation, steps.opacity]
    for luma in (steps.dc, *steps.sh):
        grid += [float(size) for size in steps.colour(luma)[:2]]
    sums, counts = np.zeros(len(grid)), np.zeros(len(grid))
    fields = (planes[name] for name in ("log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"))
    for rows, (scales, quats, logits, constant, rest) in read_ahead(len(degrees), *fields):
        colours, own = _luma_and_chroma(constant) - centres[4:, None], degrees[rows]
        kinds = [scales - centres[:3, None], quats[1:], logits - centres[3], colours[:1], colours[1:]]
        bands = rest.reshape(3, -1, len(own))
        for level in range(1, len(steps.sh) + 1):
            band = _luma_and_chroma(bands[:, level * level - 1 : (level + 1) ** 2 - 1, own >= level])
            kinds += [band[:1], band[1:]]
        sums += [np.abs(away).sum(dtype=np.float64) for away in kinds]
        counts += [away.size for away in kinds]
    # Where all values are alike they take no bits, and a small b must not make a large price of it.
    spreads = np.maximum(sums / np.maximum(counts, 1), np.array(grid) / 4)
    prices = np.zeros(PRICES, np.float32)
    prices[0 : 2 * len(grid) : 2] = worth / (math.log(2) * spreads)
    prices[1 : 2 * len(grid) : 2] = WIDTH * np.array(grid)
    prices[-len(centres) :] = centres
    return prices


def _centres(planes: Planes) -> np.ndarray:
    """[7] f64, medians of the three scales, opacity, Y, Co and Cg. Memory holds one column at a time."""

    def median(name: str, place: int) -> float:
        column = np.empty(planes[name].shape[1])
        for rows, (part,) in read_ahead(len(column), planes[name]):
            column[rows] = (_luma_and_chroma(part) if name == "sh_dc" else part)[place]
        return float(np.median(column, overwrite_input=True))

    scales, colours = ([median(name, place) for place in range(3)] for name in ("log_scales", "sh_dc"))
    return np.array([*scales, median("opacity_logits", 0), *colours])


def _luma_and_chroma(colours: np.ndarray) -> np.ndarray:
    """Y, Co and Cg ([3, ...] f64) of red, green and blue."""
    red, green, blue = colours.astype(np.float64)
    return np.stack([(red + 2 * green + blue) / 4, red - blue, green - (red + blue) / 2])
