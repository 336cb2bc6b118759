"""Views of several sizes that share their buffers."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.render.renderer import Renderer
from kernel_fixtures import ALL_FORMS, large_budget, open_form
from synthetic import make_camera, random_scene

BACKGROUND = (0.1, 0.5, 1.2)
SCENE = random_scene(300, 5, 1)


@pytest.mark.parametrize("form", ALL_FORMS)
def test_views_that_share_buffers_have_the_bits_of_their_own(form: str) -> None:
    sizes = ((70, 50), (33, 20), (50, 70), (16, 16))
    renderer = Renderer(open_form(form), large_budget(), background=BACKGROUND)
    found: list[list[bytes]] = [[], []]
    for alone, kept in enumerate(found):
        with renderer.load(SCENE, references=True, structure=True) as scene:
            for width, height in sizes:
                camera = make_camera(width, height)
                image = renderer.render_planes(scene, camera)
                target = np.random.default_rng(width).random(image.shape).astype(np.float16)
                sums = renderer.gradient_sums(scene, camera, target, 2.0)
                kept += [image.tobytes(), renderer.backend.read(sums).tobytes()]
                kept.append(np.float64(renderer.drawn_coverage()).tobytes())
                if alone:
                    renderer.release()
        renderer.release()
    assert found[0] == found[1]
