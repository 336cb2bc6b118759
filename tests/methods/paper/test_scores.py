"""Scores against the float64 reference, on every backend; score files and what may be wrong with them."""

from __future__ import annotations

import numpy as np
import pytest

import reference_renderer
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import InputError
from flexgs_edge.methods.paper.method import score_scene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import ALL_FORMS, large_budget, open_form, same_bits
from synthetic import joined, look_from, make_camera, make_splats, random_scene


def cameras() -> list[Camera]:
    rotation, translation = look_from(4)
    return [make_camera(40, 30), make_camera(33, 45, rotation=rotation, translation=translation)]


def scene() -> MemorySource:
    """50 Gaussians and two that no camera sees."""
    return joined(random_scene(50, 31), make_splats(np.array([[0, 0, -9.0], [90, 0, 5]]), np.full((2, 3), 0.1)))


def score(form: str, kind: str, source: MemorySource, views: list[Camera]) -> np.ndarray:
    renderer = Renderer(open_form(form), large_budget())
    with renderer.load(source) as loaded:
        result = score_scene(renderer, loaded, source, views, kind)
    renderer.release()
    return result


@pytest.mark.parametrize("kind", ["gs", "meson"])
@pytest.mark.parametrize("form", ALL_FORMS)
def test_scores_against_the_reference(form: str, kind: str) -> None:
    """gs: o V^0.1 hits; meson: V^0.1 sum(alpha T); as logarithms, -inf where nothing was seen."""
    source = scene()
    references = [reference_renderer.render(source, camera) for camera in cameras()]
    arrays = source.read(slice(0, source.count), list(FIELD))
    volume = np.exp(arrays["log_scales"].astype(np.float64).sum(axis=0)) ** 0.1
    opacity = 1 / (1 + np.exp(-arrays["opacity_logits"][0].astype(np.float64)))
    hits = np.sum([reference.hits for reference in references], axis=0)
    weights = np.sum([reference.weights for reference in references], axis=0)
    sure = np.sum([reference.unsure for reference in references], axis=0) == 0
    got = score(form, kind, source, cameras())
    with np.errstate(divide="ignore"):
        expected = np.log(opacity * volume * hits if kind == "gs" else volume * weights)
    assert got.dtype == np.float64 and got.shape == (52,)
    assert sure.mean() > 0.5 and (hits[sure] > 0).sum() > 20
    np.testing.assert_allclose(got[sure], expected[sure], atol=1e-9 if kind == "gs" else 1e-3)
    assert (got[-2:] == -np.inf).all()
    assert not np.isnan(got).any()


@pytest.mark.parametrize("kind", ["gs", "meson"])
def test_every_backend_gives_the_same_scores(kind: str) -> None:
    scores = [score(form, kind, scene(), cameras()) for form in ALL_FORMS]
    assert all(same_bits(other, scores[0]) for other in scores[1:])


def test_tiny_volumes_do_not_underflow() -> None:
    """exp(-200 - 200 - 200) is no float64, its logarithm is; the rank is right."""
    source = make_splats(np.array([[0, 0, 4.0], [0.1, 0, 5]]), np.full((2, 3), 0.1))
    arrays = source.read(slice(0, 2), list(FIELD))
    arrays["log_scales"][:, 1] = -400
    scores = score("w8", "gs", MemorySource(arrays), [make_camera(20, 20)])
    assert np.isfinite(scores).all() and scores[0] > scores[1]


@pytest.mark.parametrize("form", ["w8", "numpy"])
def test_cameras_that_see_nothing(form: str) -> None:
    away = make_camera(20, 20, rotation=np.diag([-1.0, 1.0, -1.0]))
    with pytest.raises(InputError, match=r"none of the 2 cameras sees any of the 50 Gaussians.*--near"):
        score(form, "gs", random_scene(50, 31), [away, away])
