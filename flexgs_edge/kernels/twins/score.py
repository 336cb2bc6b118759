"""Twins of `cl_kernels/score.cl`: residual images, moments of dropped SH degrees, and sums of the colour refit."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import FIXED_ERROR, FIXED_LARGEST, FIXED_WEIGHT, SH_C0
from flexgs_edge.kernels.twins.arithmetic import dot3, f32, fma
from flexgs_edge.kernels.twins.project import sh_basis


def residual(size: tuple[int, ...], count: int, target: np.ndarray, image: np.ndarray, out: np.ndarray) -> None:
    """`target` (f16) minus `image` (f32), pixel by pixel."""
    out[:] = target.astype(f32) - image.reshape(-1)


def _sum_values(sums: np.ndarray, unit: float) -> np.ndarray:
    return sums.view(np.int64)[:, 0].astype(f32) * f32(unit)


def _directions(camera: np.ndarray, means: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    dx, dy, dz = (means[k] - camera[21 + k] for k in range(3))
    norm = f32(1) / np.sqrt(dot3(dx, dy, dz, dx, dy, dz))
    return dx * norm, dy * norm, dz * norm


def _add_long(acc: np.ndarray, value: np.ndarray) -> None:
    value = np.clip(value * f32(FIXED_WEIGHT), f32(-FIXED_LARGEST), f32(FIXED_LARGEST)).astype(np.int64)
    most = np.iinfo(np.int64)
    value = np.minimum(value, most.max - np.maximum(acc, 0))
    acc += np.maximum(value, most.min - np.minimum(acc, 0))


def sh_costs(
    size: tuple[int, ...],
    count: int,
    stride: int,
    base: int,
    degree: int,
    planes: int,
    plane: int,
    camera: np.ndarray,
    means: np.ndarray,
    sh_rest: np.ndarray,
    sums: np.ndarray,
    moments: np.ndarray,
) -> None:
    """Add the moments w2 d and w2 |d|^2, with d the colour of the SH above each lower degree ([degree, 4, stride] i64)."""
    w2 = _sum_values(sums[base : base + count, plane], 1.0 / FIXED_ERROR)
    some = np.flatnonzero(w2 > 0)
    basis = sh_basis(degree, *_directions(camera, means[:, some]))
    d = [np.zeros(len(some), f32) for _ in range(3)]
    for level in range(degree - 1, -1, -1):
        square = np.zeros(len(some), f32)
        for c in range(3):
            for k in range((level + 1) ** 2 - 1, (level + 2) ** 2 - 1):
                d[c] = fma(basis[k], sh_rest[c * len(basis) + k, some], d[c])
            square = fma(d[c], d[c], square)
            part = moments[level, c, some]
            _add_long(part, w2[some] * d[c])
            moments[level, c, some] = part
        part = moments[level, 3, some]
        _add_long(part, w2[some] * square)
        moments[level, 3, some] = part


def sh_residual(
    size: tuple[int, ...],
    count: int,
    stride: int,
    base: int,
    degree: int,
    planes: int,
    camera: np.ndarray,
    means: np.ndarray,
    sums: np.ndarray,
    normal: np.ndarray,
) -> None:
    """Add Y_k sum(alpha T r) and |Y_k| sum(alpha T) of one view to `normal` ([K + 1, 4, stride])."""
    span = slice(base, base + count)
    weight, *seen = (_sum_values(sums[span, c], 1.0 / FIXED_WEIGHT) for c in range(4))
    some = np.flatnonzero(weight > 0)
    basis = sh_basis(degree, *_directions(camera, means[:, some]))
    for k, function in enumerate([np.full(len(some), SH_C0, f32), *basis]):
        for c in range(3):
            normal[k, c, some] = fma(function, seen[c][some], normal[k, c, some])
        normal[k, 3, some] = fma(np.abs(function), weight[some], normal[k, 3, some])
