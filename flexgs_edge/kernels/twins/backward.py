"""Twins of `cl_kernels/backward.cl`: gradients of stored values from a view's sums."""

import numpy as np

from flexgs_edge.constants import FACTOR_MIN, FIXED_MOMENT, FIXED_WEIGHT, LOG2_E, SH_C0, SH_C1, SH_C2, SH_C3, SH_C4
from flexgs_edge.kernels.twins.arithmetic import Array, Size, Triple, dot3, f32, fexp2, fma
from flexgs_edge.kernels.twins.project import sh_basis

AT_SCALE, AT_QUAT, AT_LOGIT, AT_DC, AT_SH = 3, 6, 10, 11, 14
"""First plane of each kind of value in a gradient; the means come before them."""

_LN2 = f32(1) / f32(LOG2_E)


def sh_slopes(degree: int, x: Array, y: Array, z: Array) -> list[Triple]:
    """Derivatives of the basis functions above degree 0, in the written forms of sh.clh."""
    none = np.zeros_like(x)
    slopes: list[Triple] = []
    if degree > 0:
        c1 = np.full_like(x, SH_C1)
        slopes += [(none, -c1, none), (none, none, c1), (-c1, none, none)]
    xx, yy, zz = x * x, y * y, z * z
    one, two, three, four, six, eight = (f32(n) for n in (1, 2, 3, 4, 6, 8))
    if degree > 1:
        c = [f32(value) for value in SH_C2]
        slopes += [
            (c[0] * y, c[0] * x, none),
            (none, c[1] * z, c[1] * y),
            (c[2] * (-two * x), c[2] * (-two * y), c[2] * (four * z)),
            (c[3] * z, none, c[3] * x),
            (c[4] * (two * x), c[4] * (-two * y), none),
        ]
    xy, xz, yz, away = x * y, x * z, y * z, three * xx - three * yy
    if degree > 2:
        c = [f32(value) for value in SH_C3]
        slopes += [
            (c[0] * (six * xy), c[0] * away, none),
            (c[1] * yz, c[1] * xz, c[1] * xy),
            (c[2] * (-two * xy), c[2] * (four * zz - (xx + three * yy)), c[2] * (eight * yz)),
            (c[3] * (-six * xz), c[3] * (-six * yz), c[3] * (six * zz - three * (xx + yy))),
            (c[4] * (four * zz - (three * xx + yy)), c[4] * (-two * xy), c[4] * (eight * xz)),
            (c[5] * (two * xz), c[5] * (-two * yz), c[5] * (xx - yy)),
            (c[6] * away, c[6] * (-six * xy), none),
        ]
    if degree > 3:
        c = [f32(value) for value in SH_C4]
        p, q, seven, xyz = three * xx - yy, xx - three * yy, f32(7) * zz, xy * z
        most, least = seven - one, seven - three
        slopes += [
            (c[0] * (y * p), c[0] * (x * q), none),
            (c[1] * (six * xyz), c[1] * (z * away), c[1] * (y * p)),
            (c[2] * (y * most), c[2] * (x * most), c[2] * (f32(14) * xyz)),
            (none, c[3] * (z * least), c[3] * (y * (three * seven - three))),
            (none, none, c[4] * (z * (f32(140) * zz - f32(60)))),
            (c[5] * (z * least), none, c[5] * (x * (three * seven - three))),
            (c[6] * (two * x * most), c[6] * (-two * y * most), c[6] * (f32(14) * (z * (xx - yy)))),
            (c[7] * (z * away), c[7] * (-six * xyz), c[7] * (x * q)),
            (c[8] * (four * (x * q)), c[8] * (-four * (y * p)), none),
        ]
    return slopes


def project_backward(
    size: Size, count: int, stride: int, base: int, degree: int, antialiased: int, wide: float, camera: Array,
    means: Array, log_scales: Array, quats: Array, logits: Array, sh_rest: Array, degrees: Array, records: Array,
    sums: Array, pace: Array, gradient: Array,
) -> None:  # fmt: skip
    """Gradients ([14 + 3 K, stride]) of the rows that the view shows, and the share of a whole step that they take ([stride]).

    The share is 0 for other rows, and below 1 for those whose largest deviation over their depth is above `wide`.
    """
    fixed = sums.view(np.int64)[base : base + count, :, 0]
    seen = np.zeros(stride, bool)
    seen[:count] = (fixed != 0).any(axis=1)
    pace[:] = 0
    rows = np.flatnonzero(seen)
    moments = fixed[rows].astype(f32)
    moments[:, :4] *= f32(-2.0 / FIXED_WEIGHT)
    moments[:, 4:] *= f32(-2.0 / FIXED_MOMENT)
    record = records[base + rows, :9]
    centres, scales, turns = (plane[:, rows] for plane in (means, log_scales, quats))
    out = np.zeros((len(gradient), len(rows)), f32)
    out[AT_DC:], toward = _colours(degree, camera, centres, sh_rest[:, rows], degrees[rows], record, moments)
    out[:AT_LOGIT] = _geometry(antialiased, camera, centres, scales, turns, record, moments, toward)
    opacity = f32(1) / (f32(1) + fexp2(logits.reshape(-1)[rows] * f32(-LOG2_E)))
    out[AT_LOGIT] = moments[:, 3] * (f32(1) - opacity)
    pace[rows] = _pace(wide, camera, centres, scales)
    gradient[:, rows] = out


def _pace(wide: float, cam: Array, means: Array, log_scales: Array) -> Array:
    """Share of a whole step that each row takes ([n])."""
    px, py, pz = means
    iz = f32(1) / (fma(cam[8], pz, fma(cam[6], px, cam[7] * py)) + cam[11])
    size = fexp2(log_scales * f32(LOG2_E)).max(axis=0) * iz
    return np.where(size > f32(wide), f32(wide) / size, f32(1))


def _colours(
    degree: int, cam: Array, means: Array, sh_rest: Array, degrees: Array, record: Array, moments: Array
) -> tuple[Array, Triple]:
    """Gradients of the constant and of SH ([3 + 3 K, n]), and of the centre through the direction of view."""
    dx, dy, dz = (means[k] - cam[21 + k] for k in range(3))
    norm = f32(1) / np.sqrt(dot3(dx, dy, dz, dx, dy, dz))
    dx, dy, dz = dx * norm, dy * norm, dz * norm
    colour = [np.where(record[:, 6 + c] > 0, moments[:, c], f32(0)) for c in range(3)]
    out = [f32(SH_C0) * part for part in colour]
    none = np.zeros_like(dx)
    basis = sh_basis(degree, dx, dy, dz)
    top = np.repeat(np.arange(1, 5), [3, 5, 7, 9])
    held = [np.where(degrees >= top[k], value, f32(0)) for k, value in enumerate(basis)]
    out += [value * part for part in colour for value in held]
    tx, ty, tz = none, none, none
    if degree:
        for k, (sx, sy, sz) in enumerate(sh_slopes(degree, dx, dy, dz)):
            along = dot3(*sh_rest[k :: len(basis)], *colour)
            tx, ty, tz = fma(along, sx, tx), fma(along, sy, ty), fma(along, sz, tz)
        along = dot3(dx, dy, dz, tx, ty, tz)
        tx, ty, tz = (fma(-along, d, t) * norm for d, t in ((dx, tx), (dy, ty), (dz, tz)))
    return np.stack(out), (tx, ty, tz)


def _geometry(
    antialiased: int, cam: Array, means: Array, log_scales: Array, quats: Array, record: Array, moments: Array,
    toward: Triple,
) -> Array:  # fmt: skip
    """Gradients of means, log-scales and quaternions ([10, n])."""
    one, two = f32(1), f32(2)
    s = [fexp2(row * f32(LOG2_E)) for row in log_scales]
    big = np.fmax(np.fmax(np.abs(quats[0]), np.abs(quats[1])), np.fmax(np.abs(quats[2]), np.abs(quats[3])))
    w, x, y, z = (row / big for row in quats)
    inv = one / np.sqrt(fma(z, z, fma(y, y, fma(x, x, w * w))))
    w, x, y, z = w * inv, x * inv, y * inv, z * inv
    r = (
        (fma(-two, fma(z, z, y * y), one), two * fma(x, y, -(w * z)), two * fma(x, z, w * y)),
        (two * fma(x, y, w * z), fma(-two, fma(z, z, x * x), one), two * fma(y, z, -(w * x))),
        (two * fma(x, z, -(w * y)), two * fma(y, z, w * x), fma(-two, fma(y, y, x * x), one)),
    )
    px, py, pz = means
    cz = fma(cam[8], pz, fma(cam[6], px, cam[7] * py)) + cam[11]
    cx = fma(cam[2], pz, fma(cam[0], px, cam[1] * py)) + cam[9]
    cy = fma(cam[5], pz, fma(cam[3], px, cam[4] * py)) + cam[10]
    iz = one / cz
    u, v = cx * iz, cy * iz
    uc, vc = np.fmin(np.fmax(u, cam[17]), cam[18]), np.fmin(np.fmax(v, cam[19]), cam[20])
    j00, j11 = cam[12] * iz, cam[13] * iz
    j02, j12 = -(j00 * uc), -(j11 * vc)
    t0 = [fma(j02, cam[6 + k], j00 * cam[k]) for k in range(3)]
    t1 = [fma(j12, cam[6 + k], j11 * cam[3 + k]) for k in range(3)]
    h0, h1 = ([dot3(*t, r[0][k], r[1][k], r[2][k]) for k in range(3)] for t in (t0, t1))
    g0, g1 = ([h[k] * s[k] for k in range(3)] for h in (h0, h1))

    ca, cb, cc = record[:, 2] * (two * _LN2), record[:, 3] * _LN2, record[:, 4] * (two * _LN2)
    slope, sx, sy, sxx, sxy, syy = moments[:, 3:].T
    p00, p01 = fma(ca, sxx, cb * sxy), fma(ca, sxy, cb * syy)
    p10, p11 = fma(cb, sxx, cc * sxy), fma(cb, sxy, cc * syy)
    u00, u01, u11 = fma(p00, ca, p01 * cb), fma(p00, cb, p01 * cc), fma(p10, cb, p11 * cc)
    v0 = [fma(u00, g0[k], u01 * g1[k]) for k in range(3)]
    v1 = [fma(u01, g0[k], u11 * g1[k]) for k in range(3)]
    if antialiased:
        turns = ((1, 2), (2, 0), (0, 1))
        n = [fma(g0[k], g1[m], -(g0[m] * g1[k])) for k, m in turns]
        before = dot3(*n, *n)
        share = np.where(before > f32(FACTOR_MIN), slope / before, f32(0))
        for k, (a, b) in enumerate(turns):
            after = fma(-slope, fma(ca, g0[k], cb * g1[k]), v0[k]), fma(-slope, fma(cb, g0[k], cc * g1[k]), v1[k])
            v0[k] = fma(share, fma(g1[a], n[b], -(g1[b] * n[a])), after[0])
            v1[k] = fma(share, fma(n[a], g0[b], -(n[b] * g0[a])), after[1])
    scales = [fma(v0[k], g0[k], v1[k] * g1[k]) for k in range(3)]

    v0, v1 = [v0[k] * s[k] for k in range(3)], [v1[k] * s[k] for k in range(3)]
    turn = [fma(h0[b], v0[a], h1[b] * v1[a]) - fma(h0[a], v0[b], h1[a] * v1[b]) for a, b in ((1, 2), (2, 0), (0, 1))]
    twice = two * (inv / big)
    rotation = [
        -(twice * dot3(x, y, z, *turn)),
        twice * dot3(w, y, -z, turn[0], turn[2], turn[1]),
        twice * dot3(w, z, -x, turn[1], turn[0], turn[2]),
        twice * dot3(w, x, -y, turn[2], turn[1], turn[0]),
    ]

    w0, w1 = ([dot3(*r[k], *part) for k in range(3)] for part in (v0, v1))
    e00, e02 = dot3(*w0, cam[0], cam[1], cam[2]), dot3(*w0, cam[6], cam[7], cam[8])
    e11, e12 = dot3(*w1, cam[3], cam[4], cam[5]), dot3(*w1, cam[6], cam[7], cam[8])
    du = cam[12] * fma(ca, sx, cb * sy) - np.where(uc == u, j00 * e02, f32(0))
    dv = cam[13] * fma(cb, sx, cc * sy) - np.where(vc == v, j11 * e12, f32(0))
    deep = fma(cam[12], fma(-uc, e02, e00), cam[13] * fma(-vc, e12, e11))
    moved = du * iz, dv * iz, -(fma(iz, deep, fma(u, du, v * dv)) * iz)
    centre = [dot3(cam[k], cam[3 + k], cam[6 + k], *moved) + toward[k] for k in range(3)]
    return np.stack([*centre, *scales, *rotation])
