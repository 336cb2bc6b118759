"""What a view lacks of its target: the residual, and the structural term of a descent's loss in it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import DILATION, ROW_SPAN
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.window import window
from flexgs_edge.render.view_buffers import ViewBuffers


def target_residual(backend: Backend, buffers: ViewBuffers, target: np.ndarray) -> Any:
    """What the drawn view lacks of `target` ([3, H, W] f16, laid out as by `Renderer.render_planes`).

    The result is an array of the backend, [3 H W] f32: `target` - view.
    The target must not change afterwards, since the device may read it later.
    """
    half, residual = buffers.reference_arrays()
    backend.write(half, target.reshape(-1), stays=True)
    backend.launch("residual", (residual.shape[0],), residual.shape[0], half, buffers.image, residual)
    return residual


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
    taps, slopes = buffers.structure_arrays(weights)
    target, residual = buffers.reference_arrays()
    _, rows, stride = buffers.image.shape
    across, plane, wide = -(-stride // ROW_SPAN) * ROW_SPAN, rows * stride, slopes.shape[2]
    windows, columns = (side - size + 1 for side in (camera.height, camera.width))
    backend.launch(
        "dssim_slopes", (3 * windows * across,), across, windows, columns, stride, plane, wide, size, taps, buffers.image,
        target, slopes,
    )  # fmt: skip
    backend.launch(
        "dssim_residual", (3 * camera.height * across,), across, camera.height, stride, plane, wide, weight / 2, size, taps,
        slopes, buffers.image, target, residual,
    )  # fmt: skip
