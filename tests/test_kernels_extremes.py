"""Numbers that break kernels: every form against its twin to the last bit, and against the float64 reference within its bound."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import reference_renderer
from extreme_scenes import EXTREMES
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import ALL_FORMS, PairedBackend, count, draw, open_form
from reference_renderer import Reference


@pytest.fixture(autouse=True)
def _small_pair_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every launch compares every array."""
    monkeypatch.setattr("flexgs_edge.render.renderer.DEFAULT_PAIRS", 1 << 14)

UNSEEN = ("none in view", "needles of 30 pixels, antialiased")
"""Rows that show nothing but the background: needles of 1e-5 pixels have no light to spread over whole ones."""


@cache
def case(name: str) -> tuple[MemorySource, Reference]:
    extreme = EXTREMES[name]
    source = extreme.scene()
    return source, reference_renderer.render(
        source, extreme.camera, background=(0.2, 0.5, 1.0), antialiased=extreme.antialiased
    )


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("form", ALL_FORMS)
def test_images_and_statistics(form: str, name: str) -> None:
    extreme = EXTREMES[name]
    source, reference = case(name)
    backend = open_form(form) if form == "numpy" else PairedBackend(open_form(form), 3)
    image = draw(backend, source, extreme.camera, background=(0.2, 0.5, 1.0), antialiased=extreme.antialiased)
    statistics = count(backend, source, [extreme.camera], antialiased=extreme.antialiased)
    assert np.isfinite(image).all() and image.min() >= 0
    beyond = (abs(image - reference.image).max(axis=2) - reference.bound)[~reference.fragile]
    assert (beyond <= 0).all(), beyond.max()
    assert (abs(statistics.hits - reference.hits) <= reference.unsure).all()
    assert (abs(statistics.weight_sums - reference.weights) <= reference.weight_bound).all()


@pytest.mark.parametrize("name", EXTREMES)
def test_the_bounds_say_something(name: str) -> None:
    extreme = EXTREMES[name]
    _, reference = case(name)
    print(f"{name}: fragile {reference.fragile.mean():.3f} bound {np.median(reference.bound) / max(1,reference.image.max()):.1e} max {reference.bound[~reference.fragile].max(initial=0):.1e} hits {reference.hits.sum()} rows hit {(reference.hits>0).mean():.2f} shown {reference.shown.sum()}")
    assert 1 - reference.fragile.mean() >= extreme.sure and reference.fragile.sum() >= extreme.edges
    assert np.median(reference.bound) <= extreme.bound * max(1, reference.image.max())
    assert reference.hits.any() == (name not in UNSEEN)
