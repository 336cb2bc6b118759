"""Gradients of a view's squared error against float64 finite differences, kernels against twins, and the descent along them."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.constants import FIXED_MOMENT, FIXED_WEIGHT
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.refit.distil import ORDER, Plan, distil
from flexgs_edge.render import Renderer
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import FORMS, PairedBackend, large_budget, open_form
from synthetic import look_from, make_camera, random_scene
from test_kernels_twins import padded_target


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("pairs", [1 << 12, 1])
@pytest.mark.parametrize("form", FORMS)
def test_descent_of_kernel_and_twin(form: str, pairs: int, antialiased: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("flexgs_edge.render.renderer.DEFAULT_PAIRS", pairs)
    paired = PairedBackend(open_form(form), 3)
    rotation, translation = look_from(3)
    cameras = [make_camera(45, 37), make_camera(45, 37, rotation=rotation, translation=translation)]
    source = random_scene(70, 18, 4, size=-1.5)
    planes = source.read(slice(0, 70), list(FIELD))
    renderer = Renderer(paired, large_budget(), background=(0.1, 0.5, 1.0), antialiased=antialiased)
    targets = [padded_target(camera, 19) for camera in cameras]
    degrees = np.arange(70) % 5
    for steps in (None,):
        out = distil(renderer, planes, degrees, np.zeros(3), cameras, targets, Plan(4))
    renderer.release()
