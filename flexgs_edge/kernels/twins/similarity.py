"""Twins of `cl_kernels/similarity.cl`: SSIM of two one-channel images."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import SSIM_C1, SSIM_C2, SSIM_WINDOW
from flexgs_edge.kernels.twins.arithmetic import f32


def ssim_columns(
    size: tuple[int, ...],
    count: int,
    stride: int,
    plane: int,
    taps: np.ndarray,
    a: np.ndarray,
    b: np.ndarray,
    moments: np.ndarray,
) -> None:
    """Moments of a, b, a a, b b and a b, windowed along the columns ([5, plane])."""
    sums = moments[:, :count]
    sums[:] = 0
    for k in range(SSIM_WINDOW):
        va, vb = (image.reshape(-1)[k * stride : k * stride + count] for image in (a, b))
        ta, tb = taps[k] * va, taps[k] * vb
        for moment, value in zip(sums, (ta, tb, ta * va, tb * vb, ta * vb), strict=True):
            moment += value


def ssim_rows(
    size: tuple[int, ...], count: int, plane: int, taps: np.ndarray, moments: np.ndarray, similar: np.ndarray
) -> None:
    """SSIM of every element ([count]), from the moments, windowed along the rows too."""
    m = np.zeros((5, count), f32)
    for k in range(SSIM_WINDOW):
        m += taps[k] * moments[:, k : k + count]
    ab, aa, bb = m[0] * m[1], m[0] * m[0], m[1] * m[1]
    light = (f32(2) * ab + f32(SSIM_C1)) / (aa + bb + f32(SSIM_C1))
    both = (f32(2) * (m[4] - ab) + f32(SSIM_C2)) / ((m[2] - aa) + (m[3] - bb) + f32(SSIM_C2))
    similar[:] = light * both
