"""The structural term of a descent's loss: the gradient of a view's SSIM, added to its residual."""

from __future__ import annotations

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import SSIM_WINDOW
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.render.fit import padded
from flexgs_edge.render.view_buffers import ViewBuffers


def add_structure(backend: Backend, buffers: ViewBuffers, camera: Camera, weight: float) -> None:
    """Add minus half the gradient of `weight` times the sum of 1 - SSIM, over windows and channels, to the residual.

    SSIM is that of the drawn view and its target, both clamped to [0, 1], by windows inside the picture. A view with a
    side below the window's has none.
    """
    arrays = buffers.structure_arrays()
    if not arrays:
        return
    taps, moments, slopes = arrays
    target, residual = buffers.reference_arrays()
    _, rows, stride = buffers.image.shape
    plane, wide = moments.shape[1], slopes.shape[1]
    windows, below, pixels = (count * stride for count in (camera.height - SSIM_WINDOW + 1, camera.height + 1, camera.height))
    columns = camera.width - SSIM_WINDOW + 1
    for channel in range(3):
        first, pair = channel * rows * stride, (buffers.image, target)
        backend.launch("dssim_columns", (padded(windows),), windows, first, stride, plane, taps, *pair, moments)
        backend.launch("dssim_slopes", (padded(windows),), windows, stride, columns, plane, wide, taps, moments, slopes)
        backend.launch("dssim_columns_back", (padded(below),), below, stride, plane, wide, taps, slopes, moments)
        backend.launch(
            "dssim_residual", (padded(pixels),), pixels, first, plane, weight / 2, taps, moments, *pair, residual
        )
