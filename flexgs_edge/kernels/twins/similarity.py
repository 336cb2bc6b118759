"""Twins of `cl_kernels/similarity.cl`: SSIM of two one-channel images."""

import numpy as np

from flexgs_edge.constants import SSIM_C1, SSIM_C2, SSIM_WINDOW
from flexgs_edge.kernels.twins.arithmetic import Array, Size, f32


def _columns(count: int, stride: int, taps: Array, a: Array, b: Array, moments: Array) -> None:
    sums = moments[:, :count]
    sums[:] = 0
    for k, tap in enumerate(taps):
        va, vb = (image[k * stride : k * stride + count] for image in (a, b))
        ta, tb = tap * va, tap * vb
        for moment, value in zip(sums, (ta, tb, ta * va, tb * vb, ta * vb), strict=True):
            moment += value


def ssim_columns(
    size: Size, count: int, stride: int, plane: int, taps: Array, a: Array, b: Array, moments: Array
) -> None:
    """Moments of a, b, a a, b b and a b, windowed along the columns ([5, plane])."""
    _columns(count, stride, taps, a.reshape(-1), b.reshape(-1), moments)


def ssim_rows(size: Size, count: int, plane: int, taps: Array, moments: Array, similar: Array) -> None:
    """SSIM of every element ([count]), from the moments, windowed along the rows too."""
    m = np.zeros((5, count), f32)
    for k in range(SSIM_WINDOW):
        m += taps[k] * moments[:, k : k + count]
    ab, aa, bb = m[0] * m[1], m[0] * m[0], m[1] * m[1]
    light = (f32(2) * ab + f32(SSIM_C1)) / (aa + bb + f32(SSIM_C1))
    both = (f32(2) * (m[4] - ab) + f32(SSIM_C2)) / ((m[2] - aa) + (m[3] - bb) + f32(SSIM_C2))
    similar[:] = light * both


def _shown(values: Array) -> Array:
    """Clamped to [0, 1]; NaN gives 0."""
    above = np.where(values > 0, values, f32(0))
    return np.where(above < 1, above, f32(1))


def dssim_slopes(
    launched: Size, across: int, rows: int, columns: int, stride: int, plane: int, wide: int, size: int, taps: Array,
    image: Array, target: Array, slopes: Array,
) -> None:  # fmt: skip
    """What each window's SSIM gains by a change of its moments, named by the window's last pixel ([3, 3, wide])."""
    count, two = rows * stride, f32(2)
    sums, m = np.zeros((5, count + size), f32), np.empty((5, count), f32)
    inside, at = np.arange(count) % stride < columns, (size - 1) * (stride + 1)
    for channel in range(3):
        own = slice(channel * plane, (channel + 1) * plane)
        a, b = _shown(image.reshape(-1)[own]), _shown(target.reshape(-1)[own].astype(f32))
        _columns(count, stride, taps[:size], a, b, sums)
        m[:] = 0
        for k in range(size):
            m += taps[k] * sums[:, k : k + count]
        ab, aa, bb = m[0] * m[1], m[0] * m[0], m[1] * m[1]
        means, variances = aa + bb + f32(SSIM_C1), (m[2] - aa) + (m[3] - bb) + f32(SSIM_C2)
        light = (two * ab + f32(SSIM_C1)) / means
        both = (two * (m[4] - ab) + f32(SSIM_C2)) / variances
        by_mean = both * (m[1] - light * m[0]) / means + light * (both * m[0] - m[1]) / variances
        found = two * by_mean, -(light * both / variances), two * light / variances
        for plane_of, value in zip(slopes.reshape(-1)[: 9 * wide].reshape(3, 3, wide)[channel], found, strict=True):
            plane_of[at : at + count] = np.where(inside, value, f32(0))


def dssim_residual(
    launched: Size, across: int, rows: int, stride: int, plane: int, wide: int, factor: float, size: int, taps: Array,
    slopes: Array, image: Array, target: Array, residual: Array,
) -> None:  # fmt: skip
    """Add the gradient of all windows' SSIM by `image`, times `factor`, to `residual`."""
    count = rows * stride
    for channel in range(3):
        own_slopes = slopes.reshape(-1)[: 9 * wide].reshape(3, 3, wide)[channel]
        sums, by = np.zeros((3, count + size), f32), np.zeros((3, count), f32)
        for k in range(size):
            sums[:, :count] += taps[k] * own_slopes[:, k * stride : k * stride + count]
        for k in range(size):
            by += taps[k] * sums[:, k : k + count]
        own = slice(channel * plane, channel * plane + count)
        a, b = image.reshape(-1)[own], _shown(target.reshape(-1)[own].astype(f32))
        slope = by[0] + f32(2) * a * by[1] + b * by[2]
        residual.reshape(-1)[own] += np.where((a >= 0) & (a <= 1), f32(factor) * slope, f32(0))
