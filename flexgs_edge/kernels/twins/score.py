"""Twins of `cl_kernels/score.cl`: residual images, costs of removal and of dropped SH degrees, and sums of the colour refit."""

import numpy as np

from flexgs_edge.constants import FIXED_ERROR, FIXED_LARGEST, FIXED_WEIGHT, SH_C0
from flexgs_edge.kernels.twins.arithmetic import Array, Size, dot3, f32, fma
from flexgs_edge.kernels.twins.project import block_rows, sh_basis


def residual(size: Size, count: int, target: Array, image: Array, out: Array) -> None:
    """`target` (f16) minus `image` (f32), pixel by pixel."""
    out[:count] = target[:count].astype(f32) - image.reshape(-1)[:count]


def _sum_values(sums: Array, unit: float) -> Array:
    return sums.view(np.int64)[:, 0].astype(f32) * f32(unit)


def _directions(camera: Array, means: Array) -> tuple[Array, Array, Array]:
    dx, dy, dz = (means[k] - camera[21 + k] for k in range(3))
    norm = f32(1) / np.sqrt(dot3(dx, dy, dz, dx, dy, dz))
    return dx * norm, dy * norm, dz * norm


def _add_long(acc: Array, value: Array) -> None:
    value = np.clip(value * f32(FIXED_WEIGHT), f32(-FIXED_LARGEST), f32(FIXED_LARGEST)).astype(np.int64)
    most = np.iinfo(np.int64)
    value = np.minimum(value, most.max - np.maximum(acc, 0))
    acc += np.maximum(value, most.min - np.minimum(acc, 0))


def _planes_first(sums: Array) -> Array:
    """Sums over views as [planes, stride], a copy; from [stride / SUM_LANES, planes, SUM_LANES]."""
    groups, *_, lanes = sums.shape
    return np.moveaxis(sums.reshape(groups, -1, lanes), 1, 0).reshape(-1, groups * lanes)


def _put_back(sums: Array, planes: Array) -> None:
    groups, *_, lanes = sums.shape
    sums[...] = np.moveaxis(planes.reshape(-1, groups, lanes), 0, 1).reshape(sums.shape)


def add_costs(
    size: Size, count: int, stride: int, base: int, first: int, degree: int, planes: int, plane: int, blocks: Array,
    camera: Array, means: Array, sh_rest: Array, sums: Array, costs: Array,
) -> None:  # fmt: skip
    """Add squared errors and squared weights of a view to 128-bit sums, and the moments w2 d and w2 |d|^2.

    d is the colour of the SH above each lower degree; `costs` is [stride / SUM_LANES, 4 + 4 * degree, SUM_LANES] i64.
    """
    own, span = block_rows(blocks, first, count), slice(base, base + count)
    whole = _planes_first(costs)
    for k in range(2):
        value = np.ascontiguousarray(sums[span, plane + k]).view(np.uint64)[:, 0]
        low = whole[2 * k].view(np.uint64)
        low[own] += value
        whole[2 * k + 1, own] += low[own] < value
    moments = whole[4:].reshape(degree, 4, stride)
    w2 = _sum_values(sums[span, plane + 1], 1.0 / FIXED_ERROR)
    seen = np.flatnonzero(w2 > 0)
    some, w2 = own[seen], w2[seen]
    basis = sh_basis(degree, *_directions(camera, means[:, some]))
    d = [np.zeros(len(some), f32) for _ in range(3)]
    for level in range(degree - 1, -1, -1):
        square = np.zeros(len(some), f32)
        for c in range(3):
            for k in range((level + 1) ** 2 - 1, (level + 2) ** 2 - 1):
                d[c] = fma(basis[k], sh_rest[c * len(basis) + k, some], d[c])
            square = fma(d[c], d[c], square)
            part = moments[level, c, some]
            _add_long(part, w2 * d[c])
            moments[level, c, some] = part
        part = moments[level, 3, some]
        _add_long(part, w2 * square)
        moments[level, 3, some] = part
    _put_back(costs, whole)


def sh_residual(
    size: Size, count: int, stride: int, base: int, first: int, degree: int, planes: int, blocks: Array, camera: Array,
    means: Array, sums: Array, normal: Array,
) -> None:  # fmt: skip
    """Add Y_k sum(alpha T r) and |Y_k| sum(alpha T) of one view to `normal` ([stride / SUM_LANES, K + 1, 4, SUM_LANES])."""
    own, span = block_rows(blocks, first, count), slice(base, base + count)
    weight, *seen = (_sum_values(sums[span, c], 1.0 / FIXED_WEIGHT) for c in range(4))
    places = np.flatnonzero(weight > 0)
    some, whole = own[places], _planes_first(normal)
    basis = sh_basis(degree, *_directions(camera, means[:, some]))
    for k, function in enumerate([np.full(len(some), SH_C0, f32), *basis]):
        for c in range(3):
            whole[4 * k + c, some] = fma(function, seen[c][places], whole[4 * k + c, some])
        whole[4 * k + 3, some] = fma(np.abs(function), weight[places], whole[4 * k + 3, some])
    _put_back(normal, whole)
