"""Twin of `cl_kernels/project.cl`."""

import math

import numpy as np

from flexgs_edge import constants
from flexgs_edge.kernels.twins.arithmetic import Array, Size, Triple, dot3, f32, flog2, fma
from flexgs_edge.kernels.twins.tiles import only_tiles

_LOG2_E = f32(constants.LOG2_E)


def sh_basis(degree: int, x: Array, y: Array, z: Array) -> list[Array]:
    """Basis functions above degree 0 in unit directions (x, y, z), in the written forms of project.cl."""
    basis: list[Array] = []
    if degree > 0:
        c1 = f32(constants.SH_C1)
        basis += [-c1 * y, c1 * z, -c1 * x]
    if degree > 1:
        xx, yy, zz = x * x, y * y, z * z
        c2 = [f32(c) for c in constants.SH_C2]
        basis += [c2[0] * (x * y), c2[1] * (y * z), c2[2] * ((zz + zz) - (xx + yy)), c2[3] * (x * z), c2[4] * (xx - yy)]
    if degree > 2:
        c3 = [f32(c) for c in constants.SH_C3]
        three, four = f32(3), f32(4)
        basis += [
            c3[0] * (y * (three * xx - yy)),
            c3[1] * ((x * y) * z),
            c3[2] * (y * (four * zz - (xx + yy))),
            c3[3] * (z * (f32(2) * zz - three * (xx + yy))),
            c3[4] * (x * (four * zz - (xx + yy))),
            c3[5] * (z * (xx - yy)),
            c3[6] * (x * (xx - three * yy)),
        ]
    if degree > 3:
        c4 = [f32(c) for c in constants.SH_C4]
        one, three, seven = f32(1), f32(3), f32(7)
        basis += [
            c4[0] * ((x * y) * (xx - yy)),
            c4[1] * ((y * z) * (three * xx - yy)),
            c4[2] * ((x * y) * (seven * zz - one)),
            c4[3] * ((y * z) * (seven * zz - three)),
            c4[4] * (zz * (f32(35) * zz - f32(30)) + three),
            c4[5] * ((x * z) * (seven * zz - three)),
            c4[6] * ((xx - yy) * (seven * zz - one)),
            c4[7] * ((x * z) * (xx - three * yy)),
            c4[8] * (xx * (xx - three * yy) - yy * (three * xx - yy)),
        ]
    return basis


def block_rows(blocks: Array, first: int, count: int) -> Array:
    """[count] i64, the rows of a chunk in its part of a view: those of `blocks` from place `first` on."""
    some = blocks[first : first - (-count // constants.ROW_BLOCK)].astype(np.int64)
    return (some[:, None] * constants.ROW_BLOCK + np.arange(constants.ROW_BLOCK)).reshape(-1)[:count]


def _bounds(mx: Array, my: Array, half: tuple[Array, Array], cam: Array) -> tuple[Array, Array, Array, Array]:
    """Number of tiles of the bounding box, whether there are any, and column and row of the first one."""
    per_tile, spans = f32(1.0 / constants.TILE), []
    for centre, half_extent, slack_factor, pixels in ((mx, half[0], f32(2), cam[24]), (my, half[1], f32(1), cam[25])):
        slack = slack_factor * fma(half_extent, f32(constants.SPAN_SLACK_RELATIVE), f32(constants.SPAN_SLACK))
        first = np.floor(np.ceil(centre - half_extent - slack) * per_tile)
        last = np.floor(np.floor(centre + half_extent + slack) * per_tile)
        first = np.fmax(first, f32(0))
        last = np.fmin(last, np.floor((pixels - f32(1)) * per_tile))
        spans.append((first, last))
    (x0, x1), (y0, y1) = spans
    return (x1 - x0 + f32(1)) * (y1 - y0 + f32(1)), (x1 >= x0) & (y1 >= y0), x0, y0


def _from_covariance(cov: Array, t0: Triple, t1: Triple, dilation: np.float32) -> tuple[Array, Array, Array, Array]:
    """Entries a, b, c and the determinant of the dilated 2D covariance, from the 3D covariance."""
    cxx, cxy, cxz, cyy, cyz, czz = cov
    v0 = (dot3(cxx, cxy, cxz, *t0), dot3(cxy, cyy, cyz, *t0), dot3(cxz, cyz, czz, *t0))
    a, b = dot3(*t0, *v0) + dilation, dot3(*t1, *v0)
    v1 = (dot3(cxx, cxy, cxz, *t1), dot3(cxy, cyy, cyz, *t1), dot3(cxz, cyz, czz, *t1))
    c = dot3(*t1, *v1) + dilation
    bb = b * b
    return a, b, c, fma(a, c, -bb) + fma(-b, b, bb)


def _from_factor(
    factor: Array, t0: Triple, t1: Triple, dilation: np.float32
) -> tuple[Array, Array, Array, Array, Array]:
    """As `_from_covariance`, from the triangular factor.

    It also gives the determinant before the dilation, as a share of that after it.
    """
    fxx, fyx, fzx, fyy, fzy, fzz = factor
    g0, g1 = ((dot3(fxx, fyx, fzx, *t), fma(fzy, t[2], fyy * t[1]), fzz * t[2]) for t in (t0, t1))
    cross = tuple(fma(g0[k], g1[m], -(g0[m] * g1[k])) for k, m in ((1, 2), (2, 0), (0, 1)))
    before = dot3(*cross, *cross)
    a, b, c = dot3(*g0, *g0), dot3(*g0, *g1), dot3(*g1, *g1)
    det = before + fma(a + c, dilation, dilation * dilation)
    return a + dilation, b, c + dilation, det, before / det


def project(
    size: Size, count: int, stride: int, base: int, first: int, degree: int, antialiased: int, blocks: Array,
    camera: Array, means: Array, cov: Array, log2_opacity: Array, sh_dc: Array, sh_rest: Array, records: Array,
    keys: Array, bounds: Array,
) -> None:  # fmt: skip
    """Project the rows of some blocks to splat records ([N, 16]), depth keys and bounds ([N]) from row `base` on."""
    cam, own = camera, block_rows(blocks, first, count)
    px, py, pz = means[:, own]
    z = fma(cam[8], pz, fma(cam[6], px, cam[7] * py)) + cam[11]
    level = log2_opacity[own]
    shown = (z > cam[16]) & (level > f32(-1e30))

    x = fma(cam[2], pz, fma(cam[0], px, cam[1] * py)) + cam[9]
    y = fma(cam[5], pz, fma(cam[3], px, cam[4] * py)) + cam[10]
    iz = f32(1) / z
    u, v = x * iz, y * iz
    mx, my = fma(cam[12], u, cam[14]), fma(cam[13], v, cam[15])
    uc, vc = np.fmin(np.fmax(u, cam[17]), cam[18]), np.fmin(np.fmax(v, cam[19]), cam[20])
    j00, j11 = cam[12] * iz, cam[13] * iz
    j02, j12 = -(j00 * uc), -(j11 * vc)
    t0 = tuple(fma(j02, cam[6 + k], j00 * cam[k]) for k in range(3))
    t1 = tuple(fma(j12, cam[6 + k], j11 * cam[3 + k]) for k in range(3))

    if antialiased:
        a, b, c, det, share = _from_factor(cov[:, own], t0, t1, cam[26])
        shown &= share >= f32(constants.SHARE_MIN)
        level = fma(f32(0.5), flog2(np.where(share > f32(constants.SHARE_MIN), share, f32(constants.SHARE_MIN))), level)
        shown &= level >= -(f32(constants.LOG2_255) + f32(constants.EXTENT_SLACK))
    else:
        a, b, c, det = _from_covariance(cov[:, own], t0, t1, cam[26])
    t2 = np.fmax((level + (f32(constants.LOG2_255) + f32(constants.EXTENT_SLACK))) * (f32(2) / _LOG2_E), f32(0))
    half = (np.sqrt(t2 * a), np.sqrt(t2 * c))
    shown &= (det > 0) & (det < np.inf) & (a < np.inf) & (c < np.inf)
    shown &= (mx + half[0] >= f32(-1)) & (mx - half[0] <= cam[24])
    shown &= (my + half[1] >= f32(-1)) & (my - half[1] <= cam[25])

    k = (f32(1) / det) * (f32(0.5) * _LOG2_E)
    ic = f32(1) / c
    tiles, some, column, row = _bounds(mx, my, half, cam)
    shown &= some

    out = np.zeros((count, 16), f32)
    fields = (mx, my, c * k, -(b + b) * k, a * k, level), ((b / a) * half[0], half[1], b * ic, ic, det * ic, t2)
    out[:, :6], out[:, 9:15] = np.stack(fields[0], axis=1), np.stack(fields[1], axis=1)
    if math.prod(-(-int(pixels) // constants.TILE) for pixels in cam[24:26]) <= constants.MOST_NUMBERED:
        one = np.flatnonzero(shown & (tiles == 1))
        words = only_tiles(out[one], column[one], row[one], cam[24])
        out[one, 15] = words.view(f32)
        shown[one] = (words & 0xFFFF) > 0
    rows = np.flatnonzero(shown)
    out[rows, 6:9] = np.stack(_colours(rows, degree, cam, (px, py, pz), sh_dc[:, own], sh_rest[:, own]), axis=1)
    records[base + rows] = out[rows]
    keys[base : base + count] = np.where(shown, z.view(np.uint32), np.uint32(constants.CULLED))
    bounds[base : base + count] = np.where(shown, tiles, 0).astype(np.uint32)


def _colours(
    rows: Array, degree: int, cam: Array, position: tuple[Array, Array, Array], sh_dc: Array, sh_rest: Array
) -> list[Array]:
    dx, dy, dz = (p[rows] - cam[21 + k] for k, p in enumerate(position))
    norm = f32(1) / np.sqrt(dot3(dx, dy, dz, dx, dy, dz))
    basis = sh_basis(degree, dx * norm, dy * norm, dz * norm)
    colours = []
    for channel in range(3):
        colour = f32(constants.SH_C0) * sh_dc[channel, rows]
        for k, function in enumerate(basis):
            colour = fma(function, sh_rest[channel * len(basis) + k, rows], colour)
        colours.append(np.fmax(colour + f32(0.5), f32(0)))
    return colours
