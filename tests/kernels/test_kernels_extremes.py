"""Numbers that break kernels: every form against its twin to the last bit, and against the float64 reference within its bound."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import reference_renderer
from benchmarks.harness import read_sums
from extreme_scenes import AHEAD, EXTREMES, changed
from fits import use_fit
from flexgs_edge.constants import FIXED_ERROR
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.check import SH_LARGEST, check_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original, References
from kernel_fixtures import ALL_FORMS, FORMS, PairedBackend, count, draw, large_budget, open_form, same_bits
from reference_renderer import Reference
from synthetic import look_from, make_camera, random_scene


@pytest.fixture(autouse=True)
def _small_pair_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every launch compares every array."""
    use_fit(monkeypatch, pairs=1 << 14)


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
    assert 1 - reference.fragile.mean() >= extreme.sure and reference.fragile.sum() >= extreme.edges
    assert np.median(reference.bound) <= extreme.bound * max(1, reference.image.max())
    assert reference.hits.any() == (name not in UNSEEN)


@pytest.mark.parametrize(("length", "most"), [(3, 5e-6), (30, 1e-4), (100, 2e-3), (1000, 0.1)])
@pytest.mark.parametrize("form", ["w16", "gpu", "numpy"])
def test_needles_of_a_million_to_one(form: str, length: float, most: float) -> None:
    """Their determinants are small differences of large numbers, and the worst case that the bound adds up says little.

    Largest errors over 24 directions were 1.3e-6, 2.9e-5, 4.8e-4 and 3.4e-2 for `length` in pixels.
    """
    for seed in range(6):
        scales = np.log([[0.1 * length], [1e-7 * length], [1e-7 * length]])
        source = changed(1, 100 + seed, log_scales=scales, opacity_logits=3, means=[[0], [0], [4]])
        exact = reference_renderer.render(source, AHEAD).image
        image = draw(open_form(form), source, AHEAD)
        assert exact.any() and image.any() and abs(image - exact).max() < most


def sums_of(backend: Backend, name: str, source: MemorySource) -> np.ndarray:
    """[6, N] i64: weights, residuals of three channels against the halved image, costs of removal, squared weights."""
    extreme = EXTREMES[name]
    renderer = Renderer(backend, large_budget(), background=(0.2, 0.5, 1.0), antialiased=extreme.antialiased)
    with renderer.load(source) as scene, References() as references:
        references.add(0, renderer.render_planes(scene, extreme.camera) / 2)
        sums = read_sums(
            renderer, renderer.residual_and_removal_sums(scene, extreme.camera, references[0]), 6, source.count
        )
    renderer.release()
    return sums


@pytest.mark.parametrize("name", EXTREMES)
@pytest.mark.parametrize("form", ALL_FORMS)
def test_costs_and_residuals(form: str, name: str) -> None:
    source, reference = case(name)
    tiles = -(-EXTREMES[name].camera.width // 16) * -(-EXTREMES[name].camera.height // 16)
    sums = sums_of(open_form(form) if form == "numpy" else PairedBackend(open_form(form), 3), name, source)
    sure = (reference.unsure == 0) & (reference.hits > 0)
    costs, squares = sums[4:] / FIXED_ERROR
    assert (sums[[0, 4, 5]] >= 0).all() and (sums[:, reference.hits + reference.unsure == 0] == 0).all()
    if not EXTREMES[name].edges:  # the reference cannot tell whose costs hang on a decision behind them
        least = np.minimum(reference.removal, 2.0**22 / 2 ** tiles.bit_length())
        assert (costs[sure] >= (1 - 2e-3) * least[sure] - 1e-6).all()
        assert (costs[sure] <= (1 + 2e-3) * reference.removal[sure] + 1e-6).all()
    np.testing.assert_allclose(squares[sure], reference.weights2[sure], rtol=2e-3, atol=1e-6)
    assert (sums[1:4][:, reference.hits + reference.unsure > 0] <= 0).all()


@pytest.mark.parametrize("form", ALL_FORMS)
def test_sums_stop_at_the_end_of_64_bits(form: str) -> None:
    """Costs of what is too bright for fixed point are the largest there are; they neither wrap nor lose their variance."""
    source, _ = case("colours of +-1e6")
    backend = open_form(form) if form == "numpy" else PairedBackend(open_form(form), 3)
    renderer = Renderer(backend, large_budget())
    camera = EXTREMES["colours of +-1e6"].camera
    with renderer.load(source) as scene:
        costs = measure_costs(renderer, scene, [camera] * 3)
    renderer.release()
    seen = costs.weight2 > 0
    assert np.median(costs.removal[seen]) > 2.0**20 and (costs.removal[seen] > 0).all()
    assert costs.sh.max() >= 2.0**31
    assert np.isfinite(costs.sh).all() and np.isfinite(costs.sh_mean).all()


@pytest.mark.parametrize("form", FORMS)
def test_a_row_at_the_camera_leaves_no_trace(form: str) -> None:
    """It has no direction to look up SH in, and shares a vector with rows that are seen."""
    arrays = random_scene(16, 80, 2).read(slice(0, 16), list(FIELD))
    arrays["means"][:, 3] = 0
    source, cameras = MemorySource(arrays, 2), [make_camera(33, 20)] * 2
    renderer = Renderer(PairedBackend(open_form(form), 3), large_budget())
    with renderer.load(source) as scene, References.of(renderer, scene, cameras) as references:
        costs = measure_costs(renderer, scene, cameras)
        planes = {**arrays, "sh_dc": arrays["sh_dc"] / 2}
        refitted = refit_colours(planes, np.full(16, 2), Original(renderer, np.zeros(3), cameras, references), rounds=2)
    renderer.release()
    assert costs.weight2[3] == 0 and not costs.sh[:, 3].any() and not costs.sh_mean[:, :, 3].any()
    assert (costs.weight2 > 0).sum() > 5
    for name, values in refitted.items():
        assert np.isfinite(values).all() and same_bits(values[:, 3], planes[name][:, 3])


def any_rows(seed: int, count: int, degree: int, wild: float) -> MemorySource:
    """Rows as `check_scene` lets them through: a part of the values wild, from lists of ends or of random bits, the rest tame."""
    rng = np.random.default_rng(seed)
    arrays = random_scene(count, seed, degree, size=rng.uniform(-4, 0)).read(slice(0, count), list(FIELD))
    ends = {
        "means": [0, -0.0, 0.2, 1e-45, 1e4, -1e6, 1e19, -3e38],
        "log_scales": [-87.3, -50, -43.7, -20, 3, 20, 43, 88.8, -3e38],
        "quats": [0, -0.0, 1e-19, 1, -1, 1e19],
        "opacity_logits": [-40, 40, -88, 88.8, 3e38, -3e38, -5.541263, 1e-45],
        "sh_dc": [-1e4, 1e4, -SH_LARGEST, SH_LARGEST, -1.7724539],
        "sh_rest": [-1e4, 1e4, -SH_LARGEST, SH_LARGEST, 1e-45],
    }
    for name, values in arrays.items():
        bits = rng.integers(0, 2**32, values.shape, dtype=np.uint32).view(np.float32)
        chosen = np.where(
            rng.random(values.shape) < 0.6, rng.choice(np.array(ends[name], np.float32), values.shape), bits
        )
        some = np.isfinite(chosen) & (rng.random(values.shape) < wild)
        if name.startswith("sh"):
            some &= np.abs(chosen) <= SH_LARGEST
        values[some] = chosen[some]
    norm = np.linalg.norm(arrays["quats"].astype(np.float64), axis=0)
    arrays["quats"][:, (norm < 1.1e-19) | (norm > 1.8e19)] = [[1], [0], [0], [0]]
    return MemorySource(arrays, degree)


@pytest.mark.parametrize("form", FORMS)
@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 40),
    degree=st.integers(0, 4),
    wild=st.sampled_from([0.02, 0.2, 1.0]),
    antialiased=st.booleans(),
    size=st.sampled_from([(1, 1), (17, 33), (40, 16)]),
    turned=st.booleans(),
)
def test_any_rows(
    form: str, seed: int, count: int, degree: int, wild: float, antialiased: bool, size: tuple[int, int], turned: bool
) -> None:
    """Whatever a valid file holds: kernel and twin alike in every array, images finite, sums of squares not below zero."""
    source = check_scene(any_rows(seed, count, degree, wild))
    rotation, translation = look_from(seed) if turned else (None, (0.0, 0.0, 0.0))
    camera = make_camera(*size, rotation=rotation, translation=translation)
    paired = PairedBackend(open_form(form), 3)
    renderer = Renderer(paired, large_budget(), antialiased=antialiased)
    with renderer.load(source) as scene, References() as references:
        image = renderer.render_planes(scene, camera)
        assert np.isfinite(image).all() and image.min() >= 0
        references.add(0, image[:, ::-1] / 3)
        sums = renderer.residual_and_removal_sums(scene, camera, references[0])
        assert (read_sums(renderer, sums, 6, source.count)[[0, 4, 5]] >= 0).all()
        costs = measure_costs(renderer, scene, [camera] * 2)
    renderer.release()
    for values in (costs.removal, costs.weight2, costs.sh):
        assert np.isfinite(values).all() and (values >= 0).all()
    assert np.isfinite(costs.sh_mean).all()
