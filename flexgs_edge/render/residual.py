"""What a view lacks of its target: the residual, and the structural term of a descent's loss in it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import DILATION
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.window import window
from flexgs_edge.render.fit import padded
from flexgs_edge.render.view_buffers import ViewBuffers


def target_residual(backend: Backend, buffers: ViewBuffers, target: np.ndarray) -> Any:
    """`target` ([3, H, W] f16, in the layout of `Renderer.render_planes`) minus the drawn view: [3 H W] f32 on the backend."""
    half, residual = buffers.reference_arrays()
    backend.write(half, target.reshape(-1))
    backend.launch("residual", (residual.shape[0],), residual.shape[0], half, buffers.image, residual)
    return residual


def scale_residual(backend: Backend, buffers: ViewBuffers, factor: float) -> None:
    """Multiply the residual by `factor`."""
    _, residual = buffers.reference_arrays()
    backend.write(residual, backend.read(residual) * np.float32(factor))


def add_structure(backend: Backend, buffers: ViewBuffers, camera: Camera, weight: float) -> None:
    """Add minus half the gradient of `weight` times the sum of 1 - SSIM, over windows and channels, to the residual.

    SSIM is that of the drawn view and its target, both clamped to [0, 1], by windows inside the picture. The windows of
    a sampled view (`Camera.every`) cover as much of the picture as those of a whole view. A view with a side below the
    window's has no term.
    """
    weights = window(round(math.sqrt(DILATION / camera.dilation)))
    size = len(weights)
    if min(camera.width, camera.height) < size:
        return
    taps, moments, slopes = buffers.structure_arrays()
    target, residual = buffers.reference_arrays()
    backend.write(taps, weights)
    backend.fill(slopes, 0)  # the kernels rely on zeros around the slopes that they write
    _, rows, stride = buffers.image.shape
    plane, wide, columns = moments.shape[1], slopes.shape[1], camera.width - size + 1
    windows, below, pixels = (n * stride for n in (camera.height - size + 1, camera.height + 1, camera.height))
    for first in (channel * rows * stride for channel in range(3)):
        pair = (buffers.image, target)
        backend.launch("dssim_columns", (padded(windows),), windows, first, stride, plane, size, taps, *pair, moments)
        backend.launch(
            "dssim_slopes", (padded(windows),), windows, stride, columns, plane, wide, size, taps, moments, slopes
        )
        backend.launch("dssim_columns_back", (padded(below),), below, stride, plane, wide, size, taps, slopes, moments)
        backend.launch(
            "dssim_residual", (padded(pixels),), pixels, first, plane, weight / 2, size, taps, moments, *pair, residual
        )  # fmt: skip
