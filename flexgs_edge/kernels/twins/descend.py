"""Twins of `cl_kernels/descend.cl`: steps of values along their gradients, and rounding to the grid."""

import numpy as np

from flexgs_edge.constants import GRADIENT_MIN
from flexgs_edge.kernels.twins.activate import activate
from flexgs_edge.kernels.twins.arithmetic import Array, Size, f32, fma
from flexgs_edge.kernels.twins.backward import AT_DC, AT_LOGIT, AT_QUAT, AT_SCALE, AT_SH


def _pull(away: Array, price: np.float32, width: np.float32) -> Array:
    return price * away / (np.abs(away) + width)


def price_bits(degree: int, prices: Array, degrees: Array, pace: Array, values: Array, gradient: Array) -> None:
    """Add what the bits of values cost to their gradients ([14 + 3 K, stride]), in rows that have gradients.

    `prices` is the record of `flexgs_edge.methods.best.refit.descent.bit_prices`.
    """
    rows = np.flatnonzero(pace > 0)
    own = values[:, rows]
    for k in range(3):
        gradient[AT_SCALE + k, rows] += _pull(own[AT_SCALE + k] - prices[26 + k], *prices[:2])
        gradient[AT_QUAT + 1 + k, rows] += _pull(own[AT_QUAT + 1 + k], *prices[2:4])
    gradient[AT_LOGIT, rows] += _pull(own[AT_LOGIT] - prices[29], *prices[4:6])
    bands = (degree + 1) ** 2 - 1
    for k in range(bands + 1):
        level = int(np.searchsorted((0, 3, 8, 15), k))
        some, at = degrees[rows] >= level, 6 + 4 * level
        centres = np.zeros(3, np.float32) if k else prices[30:33]
        places = [AT_SH + k - 1 + channel * bands if k else AT_DC + channel for channel in range(3)]
        red, green, blue = own[:, some][places]
        both = red + blue
        luma = (both + f32(2) * green) * f32(0.25) - centres[0]
        orange = red - blue - centres[1]
        moss = (f32(2) * green - both) * f32(0.5) - centres[2]
        by_luma = _pull(luma, *prices[at : at + 2]) * f32(0.25)
        by_orange, by_moss = _pull(orange, *prices[at + 2 : at + 4]), _pull(moss, *prices[at + 2 : at + 4]) * f32(0.5)
        rest = by_luma - by_moss
        gradient[places[0], rows[some]] += rest + by_orange
        gradient[places[1], rows[some]] += f32(2) * (by_luma + by_moss)
        gradient[places[2], rows[some]] += rest - by_orange


def adam(
    planes: int, decay_first: float, decay_second: float, rates: Array, pace: Array, gradient: Array, powers: Array,
    first: Array, second: Array, values: Array,
) -> None:  # fmt: skip
    """One step of Adam for the rows with a share above 0; running means, powers of the decays and values change in place."""
    rows = np.flatnonzero(pace > 0)
    one, least = f32(1), f32(GRADIENT_MIN)
    decays = f32(decay_first), f32(decay_second)
    for k, decay in enumerate(decays):
        powers[k, rows] *= decay
    whole = [one / (one - powers[k, rows]) for k in range(2)]
    for k in range(planes):
        g = gradient[k, rows]
        g = np.where(np.abs(g) >= least, g, f32(0))
        mean = fma(decays[0], first[k, rows], (one - decays[0]) * g)
        mean = np.where(np.abs(mean) >= least, mean, f32(0))
        square = fma(decays[1], second[k, rows], (one - decays[1]) * (g * g))
        square = np.where(square >= least * least, square, f32(0))
        step = (mean * whole[0]) / (np.sqrt(square * whole[1]) + least)
        first[k, rows], second[k, rows] = mean, square
        values[k, rows] = fma(-rates[k] * pace[rows], step, values[k, rows])


def follow(size: Size, stride: int, planes: int, share: float, values: Array, mean: Array) -> None:
    """Move a running mean of values towards them by a share, in place; a share of 1 begins it anew."""
    mean[:planes] = fma(f32(share), values[:planes] - mean[:planes], mean[:planes]) if share < 1 else values[:planes]


def _on_grid(values: Array, step: np.float32) -> Array:
    return np.rint(values / step) * step if step > 0 else values


def snap(
    size: Size, stride: int, degree: int, steps: Array, values: Array, means: Array, log_scales: Array, quats: Array,
    logits: Array, sh_dc: Array, sh_rest: Array,
) -> None:  # fmt: skip
    """Round values ([14 + 3 K, stride]) to those that a file of these steps decodes to. A step of 0 leaves them as they are."""
    means[:] = _on_grid(values[:AT_SCALE], steps[0])
    log_scales[:] = _on_grid(values[AT_SCALE:AT_QUAT], steps[1])
    w, x, y, z = values[AT_QUAT:AT_LOGIT]
    if steps[2] > 0:
        inv = f32(1) / np.sqrt(fma(z, z, fma(y, y, fma(x, x, w * w))))
        inv = np.where(w < 0, -inv, inv)
        x, y, z = (_on_grid(part * inv, steps[2]) for part in (x, y, z))
        w = np.sqrt(np.fmax(f32(1) - ((x * x + y * y) + z * z), f32(0)))
    quats[:] = w, x, y, z
    logits.reshape(-1)[:] = _on_grid(values[AT_LOGIT], steps[3])
    bands = (degree + 1) ** 2 - 1
    for k in range(bands + 1):
        level = int(np.searchsorted((0, 3, 8, 15), k))
        luma_step, chroma_step = steps[4 + 2 * level : 6 + 2 * level]
        source, to, at = (
            (values[AT_SH:], sh_rest, slice(k - 1, None, bands)) if k else (values[AT_DC:AT_SH], sh_dc, slice(None))
        )
        red, green, blue = source[at]
        if luma_step > 0:
            both = red + blue
            luma = _on_grid((both + f32(2) * green) * f32(0.25), luma_step)
            half_orange = _on_grid(red - blue, chroma_step) * f32(0.5)
            half_green = _on_grid((f32(2) * green - both) * f32(0.5), chroma_step) * f32(0.5)
            rest = luma - half_green
            red, green, blue = rest + half_orange, luma + half_green, rest - half_orange
        to[at] = red, green, blue


def descend(
    size: Size, stride: int, degree: int, planes: int, antialiased: int, priced: int, follows: int, decay_first: float,
    decay_second: float, share: float, rates: Array, prices: Array, steps: Array, degrees: Array, pace: Array,
    gradient: Array, powers: Array, first: Array, second: Array, values: Array, mean: Array, means: Array,
    log_scales: Array, quats: Array, logits: Array, sh_dc: Array, sh_rest: Array, cov: Array, log2_opacity: Array,
) -> None:  # fmt: skip
    """`price_bits` if `priced`, `adam`, `follow` if it `follows`, `snap` and `activate`, one after the other."""
    if priced:
        price_bits(degree, prices, degrees, pace, values, gradient)
    adam(planes, decay_first, decay_second, rates, pace, gradient, powers, first, second, values)
    if follows:
        follow(size, stride, planes, share, values, mean)
    snap(size, stride, degree, steps, values, means, log_scales, quats, logits, sh_dc, sh_rest)
    activate(size, stride, antialiased, log_scales, quats, logits, cov, log2_opacity)
