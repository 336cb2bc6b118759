"""Orders of cameras by what they see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from flexgs_edge.cameras.order import covering_order
from synthetic import look_from, make_camera


def test_beginnings_of_the_covering_order_see_most() -> None:
    """Two clusters of points: one large, seen by two cameras from nearly one place and a third across, and one small."""
    back = np.diag([-1.0, 1.0, -1.0])
    rng = np.random.default_rng(5)
    large, small = rng.normal([[0.0], [0.0], [4.0]], 0.2, (3, 90)), rng.normal([[0.0], [0.0], [-4.0]], 0.2, (3, 30))
    points = np.hstack([large, small])
    across = np.array([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
    cameras = [
        make_camera(64, 48, translation=(5.0, 0.0, 0.0)),  # looks past all
        make_camera(64, 48),
        make_camera(64, 48, translation=(0.0, 0.1, 0.0)),
        make_camera(64, 48, rotation=across, translation=tuple(-across @ [-4.0, 0.0, 4.0])),
        make_camera(64, 48, rotation=back),
    ]
    assert covering_order(cameras, points, 0.2, 9) == [1, 3, 2, 4, 0]
    assert covering_order(cameras, points, 0.2, 2) == [1, 3]
    # What is seen again from nearly the same place is worth half of it, and 45 points more than 30 elsewhere.
    assert covering_order([cameras[i] for i in (1, 2, 4)], points, 0.2, 3) == [0, 1, 2]
    assert covering_order([cameras[i] for i in (1, 2, 4)], points[:, 31:], 0.2, 3) == [0, 2, 1]
    # Moved, turned and in another unit they are the same scene.
    turn, place = look_from(1)[0], np.array([[1e4], [-2e4], [3e3]])
    moved = [
        replace(c, rotation=c.rotation @ turn.T, translation=10 * c.translation - c.rotation @ turn.T @ place[:, 0])
        for c in cameras
    ]
    assert covering_order(moved, 10 * turn @ points + place, 2.0, 9) == [1, 3, 2, 4, 0]
    assert covering_order([], points, 0.2, 3) == [] and covering_order(cameras, points[:, :0], 0.2, 2) == [0, 1]
