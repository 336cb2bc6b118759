"""Which cameras are near to each other."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.order import nearest, squared_distances
from synthetic import make_camera

BACK = np.diag([-1.0, 1.0, -1.0])
"""Half a turn."""


def at(x: float, rotation: np.ndarray | None = None) -> Camera:
    rotation = np.eye(3) if rotation is None else rotation
    return make_camera(rotation=rotation, translation=tuple(-rotation @ [x, 0.0, 0.0]), name=f"{x:g}")


def test_distances_are_in_deviations_of_the_others_plus_those_of_directions() -> None:
    others = [at(0.0), at(2.0), at(4.0, BACK)]
    spread = (4.0 + 0.0 + 4.0) / 3  # mean squared distance from the middle
    found = squared_distances([at(1.0), at(4.0)], others)
    assert found == pytest.approx(np.array([[1 / spread, 1 / spread, 9 / spread + 4], [16 / spread, 4 / spread, 4]]))
    far = squared_distances([at(1000.0), at(4000.0)], [at(0.0), at(2000.0), at(4000.0, BACK)])
    assert far == pytest.approx(found)
    # In one place, only directions differ.
    assert squared_distances([at(1.0)], [at(1.0), at(1.0, BACK)]).tolist() == [[0.0, 4.0]]


def test_the_nearest_come_first_and_those_that_look_the_other_way_not_at_all() -> None:
    others = [at(9.0), at(1.0), at(0.2, BACK), at(3.0), at(-1.0)]
    assert nearest(at(0.0), others, 3) == [1, 4, 3]
    assert nearest(at(0.0), others, 9) == [1, 4, 3, 0]
    assert nearest(others[1], others, 1) == [3]
    assert nearest(at(0.0), [], 2) == []
