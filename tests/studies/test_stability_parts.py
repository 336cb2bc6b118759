"""Parts of the study of stability: where it looks from, and how its charts show breaks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexgs_edge.quality.psnr import mse
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.plots import BarChart, LineChart, Series, draw
from flexgs_edge.run.few_poses import visible_depths
from flexgs_edge.studies import stability
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, make_splats


def test_breaks_are_crossed_out_in_charts() -> None:
    broken = Series("a", [1.0, 2.0], [0.5, 4.0], broken=[2.0])
    failed = Series("b", [1.0, 2.0], [0.5, None], broken=[2.0])
    (axes,) = draw(LineChart("t", "x", "y", (broken, failed), limit=3.0)).axes
    crosses = [line for line in axes.lines if line.get_marker() == "x"]
    assert [line.get_ydata()[0] for line in crosses] == [4.0, 0.98]
    (axes,) = draw(BarChart("t", "y", ["one", "two"], {"a": [1.0, 4.0]}, limit=3.0)).axes
    assert [text.get_text() for text in axes.texts] == ["1.00", "\N{MULTIPLICATION SIGN}\n4.00"]


def test_other_poses_look_at_the_same_point() -> None:
    rotation, translation = look_from(2)
    camera = make_camera(90, 70, rotation=rotation, translation=translation)
    depth = 3.0
    point = camera.center + depth * camera.rotation[2]

    def seen(pose: object) -> np.ndarray:
        return pose.rotation @ point + pose.translation  # type: ignore[attr-defined]

    turned = stability.above(camera, depth, 30.0)
    np.testing.assert_allclose(seen(turned), [0, 0, depth], atol=1e-12)
    assert math.degrees(math.acos(turned.rotation[2] @ camera.rotation[2])) == pytest.approx(30.0)
    # Above: the image's down component of the way there is negative.
    assert (camera.rotation @ (turned.center - camera.center))[1] < 0


def test_depth_of_what_is_seen_and_not_of_what_it_hides() -> None:
    means = np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 9.0], [1.4, 0.0, 5.0]])
    source = make_splats(means, np.full((3, 3), 0.4), opacity=0.99)
    assert visible_depths(Renderer(open_form("w8"), large_budget()), source, [make_camera(40, 30)]) == [
        pytest.approx(3.0)
    ]


def test_the_worst_tile() -> None:
    image, reference = np.zeros((100, 70, 3), np.float32), np.zeros((100, 70, 3), np.float32)
    image[70:, 66:] = 0.5  # wholly inside the tile at the corner, 36 x 6 pixels of it
    assert stability.worst_tile(image, reference) == pytest.approx(0.25 * (30 * 4) / (36 * 6))
    assert stability.worst_tile(image, reference, side=1000) == pytest.approx(mse(image, reference))
