"""The camera as the kernels read it: one record of 32 floats."""

from __future__ import annotations

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import JACOBIAN_MARGIN
from flexgs_edge.small_matrices import product


def camera_record(camera: Camera, origin: np.ndarray, near: float) -> np.ndarray:
    """Compute the 32 floats that `project` reads, in float64, and round them once.

    `camera`: in world coordinates. `origin`: [3] f64, the world point that the scene is centred at. `near`: near plane,
    scene units. Returns [32] f32.
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
    record[21:24] = product(
        -moved.rotation.T, moved.translation
    )  # the transpose as inverse is exact enough near the origin
    record[24:27] = moved.width, moved.height, moved.dilation
    return record.astype(np.float32)
