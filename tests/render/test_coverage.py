"""How much of a view the splats cover, against the weights that they are blended with."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from kernel_fixtures import ALL_FORMS, large_budget, open_form
from synthetic import SIZES, make_camera, random_scene

COUNT = 400


def covered(
    form: str, camera: Camera, opacity: float = 0.0, **words: tuple[float, float, float]
) -> tuple[float, float]:
    """The coverage of a view, and the sum of all weights over its pixels."""
    source, renderer = random_scene(COUNT, 5, 1, opacity=opacity), Renderer(open_form(form), large_budget(), **words)
    statistics = Statistics.zeros(COUNT)
    with renderer.load(source) as scene:
        renderer.render(scene, camera)
        found = renderer.drawn_coverage()
        renderer.add_statistics(scene, camera, statistics)
    renderer.release()
    return found, float(statistics.weight_sums.sum()) / (camera.width * camera.height)


@pytest.mark.parametrize("form", ALL_FORMS)
@pytest.mark.parametrize(("width", "height"), [*SIZES, (70, 50)])
def test_it_is_the_sum_of_the_weights(form: str, width: int, height: int) -> None:
    found, weights = covered(form, make_camera(width, height))
    assert 0 < found < 1 and found == pytest.approx(weights, rel=1e-5)


def test_the_background_does_not_matter() -> None:
    camera = make_camera(70, 50)
    assert covered("w8", camera) == covered("w8", camera, background=(1.0, 0.5, 0.25))


def test_opaque_and_empty_views() -> None:
    near = make_camera(20, 20, focal=4000.0)
    assert covered("w8", near, opacity=9.0)[0] > 0.99
    away = make_camera(20, 20, translation=(0.0, 0.0, -100.0))
    assert covered("w8", away) == (0.0, 0.0)


def test_the_picture_stays_as_it_was() -> None:
    source, renderer = random_scene(COUNT, 5, 1), Renderer(open_form("w8"), large_budget())
    with renderer.load(source) as scene:
        image = renderer.render_planes(scene, make_camera())
        renderer.drawn_coverage()
        np.testing.assert_array_equal(renderer.drawn_planes(), image)
    renderer.release()
