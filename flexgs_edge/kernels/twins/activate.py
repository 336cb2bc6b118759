"""Twin of `cl_kernels/activate.cl`."""

import numpy as np

from flexgs_edge.constants import ALPHA_MIN, FACTOR_MIN, LOG2_E
from flexgs_edge.kernels.twins.arithmetic import Array, Size, Triple, dot3, f32, fexp2, flog2, fma


def activate(
    size: Size, stride: int, antialiased: int, log_scales: Array, quats: Array, logits: Array, cov: Array,
    log2_opacity: Array,
) -> None:  # fmt: skip
    """Compute the 3D covariance or its factor ([6, stride]), and log2 of the opacity ([stride], -inf below ALPHA_MIN)."""
    s0, s1, s2 = (fexp2(row * f32(LOG2_E)) for row in log_scales)
    big = np.fmax(np.fmax(np.abs(quats[0]), np.abs(quats[1])), np.fmax(np.abs(quats[2]), np.abs(quats[3])))
    w, x, y, z = (row / big for row in quats)
    inv = f32(1) / np.sqrt(fma(z, z, fma(y, y, fma(x, x, w * w))))
    w, x, y, z = w * inv, x * inv, y * inv, z * inv

    one, two = f32(1), f32(2)
    m0 = (fma(-two, fma(z, z, y * y), one) * s0, two * fma(x, y, -(w * z)) * s1, two * fma(x, z, w * y) * s2)
    m1 = (two * fma(x, y, w * z) * s0, fma(-two, fma(z, z, x * x), one) * s1, two * fma(y, z, -(w * x)) * s2)
    m2 = (two * fma(x, z, -(w * y)) * s0, two * fma(y, z, w * x) * s1, fma(-two, fma(y, y, x * x), one) * s2)
    if antialiased:
        cov[:] = _factor(m0, m1, m2)
    else:
        for row, (a, b) in enumerate(((m0, m0), (m0, m1), (m0, m2), (m1, m1), (m1, m2), (m2, m2))):
            cov[row] = dot3(*a, *b)

    opacity = one / (one + fexp2(logits.reshape(-1) * f32(-LOG2_E)))
    level = flog2(np.fmax(opacity, f32(ALPHA_MIN)))
    log2_opacity[:] = np.where(opacity >= f32(ALPHA_MIN), level, f32(-np.inf))


def _factor(m0: Triple, m1: Triple, m2: Triple) -> list[Array]:
    """Lower triangle F (xx yx zx yy zy zz) with F F^T = M M^T, from the rows of M."""
    xx = dot3(*m0, *m0)
    u = _direction(m0, xx)
    yx, zx = dot3(*m1, *u), dot3(*m2, *u)
    m1, m2 = _without(m1, yx, u), _without(m2, zx, u)
    yy = dot3(*m1, *m1)
    u = _direction(m1, yy)
    zy = dot3(*m2, *u)
    m2 = _without(m2, zy, u)
    return [np.sqrt(xx), yx, zx, np.sqrt(yy), zy, np.sqrt(dot3(*m2, *m2))]


def _direction(row: Triple, square: Array) -> Triple:
    inverse = np.where(square > f32(FACTOR_MIN), f32(1) / np.sqrt(square), f32(0))
    return row[0] * inverse, row[1] * inverse, row[2] * inverse


def _without(row: Triple, part: Array, u: Triple) -> Triple:
    return fma(-part, u[0], row[0]), fma(-part, u[1], row[1]), fma(-part, u[2], row[2])
