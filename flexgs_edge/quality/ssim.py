"""SSIM of images, computed on a backend; it equals scikit-image's SSIM with a Gaussian window."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.constants import LANES, SSIM_WINDOW
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.window import window

LOST_SHARE = 0.7  # SSIM lost against photos, as a share of what is lost against the original's renders


def modelled_ssim_drop(unlike: float) -> float:
    """SSIM lost against photos that are not there, from `unlike`, 1 - SSIM against the original's renders.

    A photo shares only a part of its structure with the original, and the rest cannot be lost:
    docs/results/tuning.md#lost_share

    >>> round(modelled_ssim_drop(0.02), 3)
    0.014
    """
    return LOST_SHARE * unlike


def ssim_bytes(width: int, height: int) -> int:
    """Bytes that `ssims` takes on the backend for images of this size."""
    return 4 * 8 * height * (-(-width // LANES) * LANES) + 4 * 5 * LANES


def ssims(backend: Backend, pairs: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[float | None]:
    """SSIM of pairs of images of one size, mean over pixels and channels (Wang et al. 2004).

    It takes a Gaussian window of sigma 1.5, population covariance, a data range of 1, and only windows inside the
    image. scikit-image gives the same with `gaussian_weights=True, use_sample_covariance=False, data_range=1`.

    `pairs`: [H, W, 3] f32; clamped to [0, 1] here. Returns `None` for images with a side below 11 pixels.
    """
    if not pairs or min(pairs[0][0].shape[:2]) < SSIM_WINDOW:
        return [None] * len(pairs)
    height, width = pairs[0][0].shape[:2]
    rows, stride = height - SSIM_WINDOW + 1, -(-width // LANES) * LANES
    count = rows * stride
    plane = count + LANES
    shapes = ((SSIM_WINDOW,), (height, stride), (height, stride), (5, plane), (count,))
    arrays = []
    try:
        for shape in shapes:
            arrays.append(backend.array(shape, np.float32))
        taps, *images, moments, similar = arrays
        backend.write(taps, window())
        backend.fill(moments, 0)  # the kernel reads beyond the last row, but does not use it
        padded = np.zeros((height, stride), np.float32)
        totals = [0.0] * len(pairs)
        for channel in range(3):
            held: list[np.ndarray | None] = [None, None]
            for place, pair in enumerate(pairs):
                for slot, image in enumerate(pair):
                    if held[slot] is image:
                        continue
                    np.clip(image[..., channel], 0.0, 1.0, out=padded[:, :width])
                    backend.write(images[slot], padded)
                    held[slot] = image
                backend.launch("ssim_columns", (count,), count, stride, plane, taps, *images, moments)
                backend.launch("ssim_rows", (count,), count, plane, taps, moments, similar)
                inside = backend.read(similar).reshape(rows, stride)[:, : width - SSIM_WINDOW + 1]
                totals[place] += float(inside.mean(dtype=np.float64))
        return [total / 3 for total in totals]
    finally:
        for array in arrays:
            array.release()
