"""The structural term of a descent: the gradient of SSIM by a drawn view, in every form, and its memory."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import Backend, TwinBackend, window
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.refit.descent import Descent
from flexgs_edge.render.fit import GRADIENT_SUMS, shapes_bytes, structure_shapes
from flexgs_edge.render.renderer import Renderer, add_structure, target_residual
from flexgs_edge.render.view_buffers import view_size
from flexgs_edge.scene.fields import FIELD
from kernel_fixtures import ALL_FORMS, FORMS, PairedBackend, large_budget, open_form, same_bits
from synthetic import make_camera, random_scene

VIEWS = ((33, 20, 1), (11, 11, 1), (32, 32, 1), (45, 37, 2), (16, 17, 3), (3, 40, 4))
"""Width, height and step of sampled views."""
BACKGROUND = (0.1, 0.5, 1.2)
CHANGE = 1e-6
"""Of a pixel, for finite differences."""


def sampled(width: int, height: int, step: int) -> Camera:
    return make_camera(width * step, height * step).every(step)


def term(backend: Backend, camera: Camera, weight: float = 2.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The view ([3, H, W] f32), its target (f16), and what the structural term adds to the residual."""
    renderer = Renderer(backend, large_budget(), background=BACKGROUND)
    with renderer.load(random_scene(60, 5, 2, -1.5), references=True, structure=True) as scene:
        image = renderer.render_planes(scene, camera)
        target = (image + np.random.default_rng(1).normal(0, 0.05, image.shape)).astype(np.float16)
        drawn = renderer._drawn
        assert drawn is not None
        before = backend.read(target_residual(backend, drawn.buffers, target)).copy()
        add_structure(backend, drawn.buffers, camera, weight)
        after = backend.read(drawn.buffers.reference_arrays()[1])
    renderer.release()
    inside = (slice(None), slice(camera.height), slice(camera.width))
    return image[inside], target[inside], np.ascontiguousarray((after - before).reshape(image.shape)[inside])


def similar(a: np.ndarray, b: np.ndarray, step: int) -> float:
    """Sum over all windows of the SSIM of two pictures ([H, W] f64, in [0, 1])."""
    taps = window(step).astype(np.float64)
    weights = np.outer(taps, taps)

    def windowed(values: np.ndarray) -> np.ndarray:
        return np.einsum("ijkl,kl->ij", sliding_window_view(values, weights.shape), weights)

    ma, mb = windowed(a), windowed(b)
    va, vb, both = windowed(a * a) - ma**2, windowed(b * b) - mb**2, windowed(a * b) - ma * mb
    found = (2 * ma * mb + 1e-4) * (2 * both + 9e-4) / ((ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4))
    return float(found.sum())


@pytest.mark.parametrize(("width", "height", "step"), VIEWS)
def test_the_term_is_the_gradient_of_ssim(width: int, height: int, step: int) -> None:
    image, target, added = term(open_form("w16"), sampled(width, height, step))
    clamped = np.clip(image.astype(np.float64), 0, 1), np.clip(target.astype(np.float64), 0, 1)
    largest = float(abs(added).max())
    assert largest > 0.1
    for channel, row, column in np.random.default_rng(2).integers(0, image.shape, (60, 3)):
        a, b = clamped[0][channel], clamped[1][channel]
        if not 0 <= image[channel, row, column] <= 1:
            assert added[channel, row, column] == 0
            continue
        sums = []
        for sign in (1, -1):
            moved = a.copy()
            moved[row, column] += sign * CHANGE
            sums.append(similar(moved, b, step))
        # Half of the weight of 2. Variances are rounded at 1e-7, about 1e-4 of SSIM's constant.
        slope = (sums[0] - sums[1]) / (2 * CHANGE)
        assert added[channel, row, column] == pytest.approx(slope, rel=1e-3, abs=1e-5 * largest)
    assert (image > 1).any()


@pytest.mark.parametrize(("width", "height", "step"), VIEWS)
def test_all_forms_give_the_same_bits(width: int, height: int, step: int) -> None:
    found = [term(open_form(form), sampled(width, height, step))[2] for form in ALL_FORMS]
    assert all(same_bits(one, found[0]) for one in found)


@pytest.mark.parametrize("form", FORMS)
def test_every_launch_is_its_twins(form: str) -> None:
    paired = PairedBackend(open_form(form), 2)
    term(paired, sampled(45, 37, 1))
    assert [paired.launched[f"dssim_{name}"] for name in ("slopes", "residual")] == [1, 1]


@pytest.mark.parametrize(("width", "height", "step"), [(10, 40, 1), (40, 4, 2), (2, 2, 4)])
def test_a_view_smaller_than_the_window_has_no_term(width: int, height: int, step: int) -> None:
    assert not term(open_form("w8"), sampled(width, height, step))[2].any()


def test_numbers_beyond_a_pictures_range_add_nothing_wild() -> None:
    """In float32, variances of values of 1e4 are noise as large as SSIM's own constants."""
    backend = open_form("w8")
    renderer, camera = Renderer(backend, large_budget(), background=(1e4, np.nan, 0.5)), make_camera(20, 20)
    with renderer.load(random_scene(9, 5, 0, -3), references=True, structure=True) as scene:
        image = renderer.render_planes(scene, camera)
        target = np.random.default_rng(1).uniform(-1, 6e4, image.shape).astype(np.float16)
        assert renderer._drawn is not None
        backend.fill(target_residual(backend, renderer._drawn.buffers, target), 0)
        add_structure(backend, renderer._drawn.buffers, camera, 0.01)
        added = backend.read(renderer._drawn.buffers.reference_arrays()[1])
    renderer.release()
    assert np.isfinite(added).all() and abs(added).max() < 1


def test_windows_of_sampled_views_cover_as_much_of_the_picture() -> None:
    assert [len(window(step)) for step in (1, 2, 3, 4, 9)] == [11, 5, 3, 3, 3]
    for step in (1, 2, 3, 4):
        np.testing.assert_allclose(window(step).sum(), 1, atol=1e-6)
        assert window(step)[len(window(step)) // 2 + 1] / window(step).max() == pytest.approx(np.exp(-(step**2) / 4.5))


def least_limit(structure: float, step: int) -> int:
    """The first limit in steps under which a descent opens; it must then be able to step."""
    planes, camera = random_scene(70, 5, 1).read(slice(0, 70), list(FIELD)), make_camera(90, 70)
    for limit in range(400_000, 4_000_000, step):
        budget = MemoryBudget(limit)
        renderer = Renderer(TwinBackend(budget), budget)
        try:
            with Descent(renderer, planes, np.ones(70, np.uint8), np.zeros(3), camera, structure) as descent:
                held = budget.used
                descent.differentiate(camera, np.zeros((3, 80, 96), np.float16))
                assert budget.used == held + 70 * 8 * GRADIENT_SUMS + 4
                return limit
        except BudgetError as error:
            assert "--memory-limit" in str(error)
        finally:
            renderer.release()
            assert budget.used == 0
    raise AssertionError("no limit is enough")


def test_its_memory_is_planned_with_the_views(monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, pairs=1 << 10)
    more = shapes_bytes(structure_shapes(view_size(TwinBackend(large_budget()), make_camera(90, 70))))
    step = 10_000
    assert more > 10 * step and abs(least_limit(0.01, step) - least_limit(0.0, step) - more) <= step
