"""Errors count more near views where the original is good: a small error costs many decibels there."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.methods.best.poses import KnownErrors, base_errors, view_weights
from flexgs_edge.render.renderer import Renderer
from kernel_fixtures import draw, large_budget, open_form
from synthetic import look_from, make_camera, random_scene


def test_base_errors_are_those_against_photos() -> None:
    source = random_scene(60, 3)
    cameras = [make_camera(40, 32, 30.0, *look_from(index), name=f"v{index}") for index in range(3)]
    photos = [
        np.clip(draw(open_form("w16"), source, camera) + more, 0, 1)
        for more, camera in zip((0.0, 0.05, 0.08), cameras, strict=True)
    ]
    found = base_errors(
        Renderer(open_form("w16"), large_budget()), source, cameras, lambda place, image: photos[place][::4, ::4]
    )
    expected = [
        np.square(np.clip(draw(open_form("w16"), source, camera.every(4)), 0, 1) - photo[::4, ::4]).mean()
        for camera, photo in zip(cameras, photos, strict=True)
    ]
    assert found == pytest.approx(np.array(expected), abs=1e-7) and found[0] < 1e-4 < found[1] < found[2]


def test_each_pose_has_the_weight_of_the_nearest_view() -> None:
    known = [make_camera(translation=(place, 0.0, 0.0)) for place in (0.0, 5.0)]
    cameras = [make_camera(translation=(place, 0.0, 0.1)) for place in (5.2, 0.3, 0.2)]
    errors = KnownErrors(known, np.array([1e-3, 3e-3]), 1.0)
    found = view_weights(errors.slopes(cameras))
    allowed = 2e-3 * (10**0.1 - 1)
    assert found.tolist() == pytest.approx([((1e-3 + allowed) / (3e-3 + allowed)) ** 4.8, 1.0, 1.0])
    # The largest weight among the poses is 1, even if the best view has no pose near it.
    assert view_weights(errors.slopes(cameras[:1])).tolist() == [1.0]
    assert KnownErrors(known, np.zeros(2), 1.0).slopes(cameras).tolist() == [1.0] * 3
