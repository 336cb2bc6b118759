"""The record of a camera that the kernels read."""

from __future__ import annotations

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import JACOBIAN_MARGIN


def camera_record(camera: Camera, origin: np.ndarray, near: float) -> np.ndarray:
    """The 32 floats that `project` reads, for a scene re-centred at `origin` ([3] f64, world).

    Everything is computed in float64 and rounded once.
    """
    moved = camera.moved(origin)
    x_low = -(moved.cx + 0.5) / moved.fx - JACOBIAN_MARGIN * moved.width / moved.fx
    x_high = (moved.width - 0.5 - moved.cx) / moved.fx + JACOBIAN_MARGIN * moved.width / moved.fx
    y_low = -(moved.cy + 0.5) / moved.fy - JACOBIAN_MARGIN * moved.height / moved.fy
    y_high = (moved.height - 0.5 - moved.cy) / moved.fy + JACOBIAN_MARGIN * moved.height / moved.fy
    record = np.zeros(32)
    record[0:9] = moved.rotation.reshape(-1)
    record[9:12] = moved.translation
    record[12:16] = moved.fx, moved.fy, moved.cx, moved.cy
    record[16:21] = near, x_low, x_high, y_low, y_high
    record[21:24] = -moved.rotation.T @ moved.translation  # so near to the origin the transpose will do
    record[24:27] = moved.width, moved.height, moved.dilation
    return record.astype(np.float32)
