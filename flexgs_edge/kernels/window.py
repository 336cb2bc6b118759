"""The window of SSIM, for the kernels of `similarity.cl`."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import SSIM_SIGMA, SSIM_WINDOW


def window(step: int = 1) -> np.ndarray:
    """[n] f32, the weights of the Gaussian window, with the sum 1.

    `step`: pixels from one row and column of a sampled picture to the next. The window covers the same part of the
    whole picture: n is `SSIM_WINDOW` at step 1, and at least 3.
    """
    reach = max(SSIM_WINDOW // 2 // step, 1)
    away = np.arange(-reach, reach + 1) * step
    taps = np.exp(-0.5 * np.square(away / SSIM_SIGMA))
    window: np.ndarray = (taps / taps.sum()).astype(np.float32)
    return window
