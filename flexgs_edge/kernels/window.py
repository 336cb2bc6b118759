"""The window of SSIM, for the kernels of `similarity.cl`."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import SSIM_SIGMA, SSIM_WINDOW


def window() -> np.ndarray:
    """[SSIM_WINDOW] f32, the weights of the Gaussian window, with the sum 1."""
    away = np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2
    taps = np.exp(-0.5 * np.square(away / SSIM_SIGMA))
    window: np.ndarray = (taps / taps.sum()).astype(np.float32)
    return window
