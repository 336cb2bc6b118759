"""The arithmetic of `cl_kernels/common.clh` in NumPy, bit for bit: fma, exp2, log2, dot products, all in float32."""

from typing import Any, Union

import numpy as np

from flexgs_edge.constants import EXP2_HIGH, EXP2_LOW, EXP2_MAGIC, EXP2_POLY, LOG2_ALPHA_MAX, LOG2_PIVOT, LOG2_POLY

f32 = np.float32
Array = np.ndarray
Size = tuple[int, ...]  # of a launch
Values = Union[Array, "np.floating[Any]"]  # An array of float32, or one float32
Triple = tuple[Array, ...]  # x, y and z of several rows

_TIE_BITS = np.int64(0x1FFFFFFF)
_TIE = np.int64(0x10000000)


def fma(a: Values, b: Values, c: Values) -> Array:
    """`a * b + c`, rounded once to float32.

    float64 holds the product of two float32 exactly. The sum is rounded to float64 and then to float32. Two roundings
    go wrong only if the float64 lies midway between two float32 and was itself rounded; then we nudge it towards the
    exact sum. Results below 2^-126 may still be off by one denormal step.
    """
    product = np.multiply(a, b, dtype=np.float64)
    total = np.asarray(product + c)
    ties = (total.view(np.int64) & _TIE_BITS) == _TIE
    if ties.any():
        addend = np.broadcast_to(np.asarray(c, np.float64), total.shape)[ties]
        factor, rounded = np.broadcast_to(product, total.shape)[ties], total[ties]
        rest = rounded - factor
        error = (factor - (rounded - rest)) + (addend - rest)
        total[ties] = np.where(error == 0, rounded, np.nextafter(rounded, np.where(error > 0, np.inf, -np.inf)))
    return total.astype(f32)


def fexp2(x: Array) -> Array:
    """2^x, as `fexp2` in common.clh; NaN gives NaN."""
    within = np.where(x > f32(EXP2_HIGH), f32(EXP2_HIGH), x)
    within = np.where(within < f32(EXP2_LOW), f32(EXP2_LOW), within)
    return np.where(x == x, fexp2_within(within), x)


def fexp2_within(x: Array) -> Array:
    """2^x for EXP2_LOW <= x <= EXP2_HIGH, as `fexp2_within` in common.clh."""
    t = x + f32(EXP2_MAGIC)
    i = np.left_shift(t.view(np.int32), 23)
    f = x - (t - f32(EXP2_MAGIC))
    p = np.full_like(f, EXP2_POLY[-1])
    for coefficient in EXP2_POLY[-2::-1]:
        p = fma(p, f, f32(coefficient))
    return (p.view(np.int32) + i).view(f32)


def flog2(x: Array) -> Array:
    """log2(x) of positive normal numbers, as `flog2` in common.clh."""
    e = (x.view(np.int32) - np.int32(LOG2_PIVOT)) >> 23
    f = (x.view(np.int32) - np.left_shift(e, 23)).view(f32) - f32(1)
    p = np.full_like(f, LOG2_POLY[-1])
    for coefficient in LOG2_POLY[-2::-1]:
        p = fma(p, f, f32(coefficient))
    return fma(p, f, e.astype(f32))


def dot3(*parts: Array) -> Array:
    """Dot product of (ax, ay, az) and (bx, by, bz), given in this order, with two fused steps, as `dot3` in common.clh."""
    ax, ay, az, bx, by, bz = parts
    return fma(az, bz, fma(ay, by, ax * bx))


def splat_exponent(*parts: Array) -> Array:
    """log2 of a splat's alpha from (dx, dy, ca, cb, cc, level), in this order, as `splat_exponent` in common.clh."""
    dx, dy, ca, cb, cc, level = parts
    row, slope = fma(-(cc * dy), dy, level), fma(ca, dx, cb * dy)
    exponent = fma(-slope, dx, row)
    highest = np.where(level < f32(LOG2_ALPHA_MAX), level, f32(LOG2_ALPHA_MAX))
    return np.where(exponent < highest, exponent, highest)
