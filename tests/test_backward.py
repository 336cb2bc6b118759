"""Gradients of a view's squared error against float64 finite differences, and kernels against twins along a descent."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

import reference_renderer
from flexgs_edge.cameras import Camera
from flexgs_edge.grid import Steps, from_grid, to_grid
from flexgs_edge.refit.descent import ORDER, Descent, widths
from flexgs_edge.refit.distil import FIELD_RATES
from flexgs_edge.render import Renderer
from flexgs_edge.scene.fields import FIELD
from kernel_fixtures import ALL_FORMS, FORMS, PairedBackend, large_budget, open_form, same_bits
from synthetic import look_from, make_camera, random_scene
from test_kernels_twins import padded_target

Planes = dict[str, np.ndarray]
BACKGROUND = (0.1, 0.5, 0.9)
RATES = {"means": 1e-2, **FIELD_RATES}
STEPS = Steps(0.01, 0.1, 0.03, 0.2, 0.05, (0.04, 0.05, 0.06, 0.07))
CHANGE = 1e-5
"""Of a value, for finite differences in float64: their own error is about its square."""


def view(seed: int, width: int = 45, height: int = 37) -> Camera:
    rotation, translation = look_from(seed)
    return make_camera(width, height, rotation=rotation, translation=translation)


def planes_of(count: int, seed: int, degree: int, size: float = -1.3, opacity: float = 0.0) -> Planes:
    return random_scene(count, seed, degree, size, opacity).read(slice(0, count), list(FIELD))


@dataclass
class Frozen:
    """Which splats each pixel blends, and where alpha is held at its cap: gradients are those between thresholds."""

    order: list[int]
    hits: dict[int, np.ndarray]
    capped: dict[int, np.ndarray]


def image_in_float64(
    arrays: Planes, degree: int, camera: Camera, antialiased: bool, frozen: Frozen | None = None
) -> tuple[np.ndarray, Frozen]:
    """[H, W, 3] f64 from float64 values by the formulas alone, with decisions frozen if they are given."""
    splats = reference_renderer._project(arrays, degree, camera, 0.2, antialiased)
    shape = camera.height, camera.width
    xs, ys = np.arange(camera.width)[None, :], np.arange(camera.height)[:, None]
    alive, trans, image = np.ones(shape, bool), np.ones(shape), np.zeros((*shape, 3))
    made = Frozen([int(k) for k in np.argsort(splats.depth, kind="stable") if splats.shown[k]], {}, {})
    for k in (frozen or made).order:
        dx, dy = xs - splats.mean[k, 0], ys - splats.mean[k, 1]
        a, b, c = splats.conic[k]
        full = splats.opacity[k] * np.exp(-(a * dx * dx + 2 * b * dx * dy + c * dy * dy) / 2)
        if frozen is None:
            capped = full >= reference_renderer.ALPHA_MAX
            alpha = np.where(capped, reference_renderer.ALPHA_MAX, full)
            seen = alive & (alpha >= reference_renderer.ALPHA_MIN)
            made.hits[k], made.capped[k] = seen & (trans * (1 - alpha) >= reference_renderer.STOP), capped
            alive &= ~(seen & ~made.hits[k])
        held = frozen or made
        alpha = np.where(held.capped[k], reference_renderer.ALPHA_MAX, full) * held.hits[k]
        image += (alpha * trans)[..., None] * splats.colour[k]
        trans = trans * (1 - alpha)
    return image + trans[..., None] * np.array(BACKGROUND), made


def measured(form: str, planes: Planes, camera: Camera, target: np.ndarray, antialiased: bool) -> Planes:
    count, degree = planes["means"].shape[1], {0: 0, 9: 1, 24: 2, 45: 3, 72: 4}[len(planes["sh_rest"])]
    renderer = Renderer(open_form(form), large_budget(), background=BACKGROUND, antialiased=antialiased)
    with Descent(renderer, planes, np.full(count, degree), np.zeros(3), camera) as descent:
        descent.differentiate(camera, target)
        gradients = descent.gradients()
    renderer.release()
    return gradients


def differences(
    planes: Planes, degree: int, camera: Camera, target: np.ndarray, antialiased: bool, rows: list[int]
) -> Planes:
    """[width, rows] by central differences of the float64 image's squared error."""
    arrays = {name: values.astype(np.float64) for name, values in planes.items()}
    wanted = target.astype(np.float64)[:, : camera.height, : camera.width].transpose(1, 2, 0)
    _, frozen = image_in_float64(arrays, degree, camera, antialiased)

    def error(name: str, plane: int, row: int, change: float) -> float:
        moved = arrays[name].copy()
        moved[plane, row] += change
        image, _ = image_in_float64({**arrays, name: moved}, degree, camera, antialiased, frozen)
        return float(np.square(image - wanted).sum())

    return {
        name: np.array(
            [
                [(error(name, plane, row, CHANGE) - error(name, plane, row, -CHANGE)) / (2 * CHANGE) for row in rows]
                for plane in range(width)
            ]
        ).reshape(width, len(rows))
        for name, width in widths(degree).items()
    }


def assert_close(found: Planes, expected: Planes, rows: list[int]) -> None:
    """Within 3e-5 of a field's largest gradient of the row, and 3e-6 of the scene's."""
    for name, wanted in expected.items():
        if wanted.size:
            largest = abs(wanted).max(axis=0)
            allowed = 3e-5 * largest + 3e-6 * largest.max() + 1e-7
            wrong = abs(found[name][:, rows] - wanted).max(axis=0)
            assert (wrong <= allowed).all(), (name, wrong / allowed)
            assert largest.max() > 0, name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("degree", range(5))
def test_gradients_are_those_of_float64(degree: int, antialiased: bool) -> None:
    """One splat lies beyond the Jacobian's clamp, one is held at the cap of alpha, one has a colour cut off at zero."""
    planes = planes_of(12, 40 + degree, degree, opacity=1.0)
    planes["means"][:, 0], planes["log_scales"][:, 0] = (4.0, 0.3, 2.5), (0.6, 0.2, -0.5)
    planes["opacity_logits"][0, :2] = 2, 9
    planes["sh_dc"][0, 2] = -9
    camera = view(degree)
    target = padded_target(camera, degree)
    found = measured("w16", planes, camera, target, antialiased)
    rows = [0, 1, 2, 5, 9]
    assert_close(found, differences(planes, degree, camera, target, antialiased, rows), rows)
    assert found["means"][:, 0].any() and found["sh_dc"][0, 2] == 0


@pytest.mark.parametrize("form", ALL_FORMS)
def test_forms_give_the_same_gradients(form: str) -> None:
    planes, camera = planes_of(65, 3, 2, -2.0), view(3)
    target = padded_target(camera, 3)
    expected = measured("w16", planes, camera, target, False)
    for name, values in measured(form, planes, camera, target, False).items():
        assert values.any() and same_bits(values, expected[name]), name


@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_descents_of_kernel_and_twin(form: str, antialiased: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every launch compared: in batches, in two chunks, off and on a grid, rows of every degree, one that is not seen."""
    monkeypatch.setattr("flexgs_edge.render.view_buffers.DEFAULT_PAIRS", 64)
    monkeypatch.setattr("flexgs_edge.render.device_scene.CHUNK_ROWS", 40)
    monkeypatch.setattr("flexgs_edge.render.device_scene.MIN_CHUNK_ROWS", 16)
    paired = PairedBackend(open_form(form), 2)
    cameras = [view(2, 33, 20), make_camera(33, 20)]
    planes = planes_of(65, 18, 4, -1.8)
    planes["means"][2, 50] = -3
    degrees = np.repeat([4, 1, 2, 3, 0], 13)
    planes["sh_rest"][:, degrees == 0] = 0
    renderer = Renderer(paired, large_budget(), background=BACKGROUND, antialiased=antialiased)
    with Descent(renderer, planes, degrees, np.zeros(3), cameras[0]) as descent:
        for k, steps in enumerate((None, STEPS)):
            descent.put_on(steps)
            descent.step(cameras[k], padded_target(cameras[k], k), RATES)
        moved = descent.planes()
    renderer.release()
    assert paired.launched["blend_backward"] > 3 and paired.launched["adam"] == 2 * 3
    for name, before in planes.items():
        assert not same_bits(moved[name], before) and same_bits(moved[name][:, 50], before[:, 50]), name
    for degree in range(1, 5):
        lower = np.flatnonzero(degrees < degree)
        band = [c * 24 + k for c in range(3) for k in range(degree**2 - 1, (degree + 1) ** 2 - 1)]
        assert same_bits(moved["sh_rest"][band][:, lower], planes["sh_rest"][band][:, lower])


def test_views_are_drawn_from_what_a_file_gives_back() -> None:
    """Values on the grid on the device are those of `from_grid`, but where float32 divides to the other side of a half."""
    planes = planes_of(300, 5, 3)
    fine = Steps(1e-5, 1e-6, 1e-6, 1e-6, 1e-6, (1e-6,) * 3)
    degrees = np.full(300, 3, np.uint8)
    planes = from_grid(to_grid(planes, degrees, fine, np.zeros(3))[0])  # quaternions in the grid's own form
    steps = replace(STEPS, sh=STEPS.sh[:3])
    grid, order = to_grid(planes, degrees, steps, np.zeros(3))
    expected = from_grid(grid)
    renderer, camera = Renderer(open_form("w16"), large_budget()), make_camera()
    with Descent(renderer, planes, degrees, np.zeros(3), camera) as descent:
        descent.put_on(steps)
        (part,) = descent._parts
        drawn = dict(
            zip(("log_scales", "quats", "opacity_logits"), map(renderer.backend.read, part.stored), strict=True)
        )
        drawn |= {name: renderer.backend.read(getattr(part.chunk, name)) for name in ("means", "sh_dc", "sh_rest")}
        assert same_bits(descent.planes()["quats"], planes["quats"])
    renderer.release()
    for name in ORDER:
        same = (drawn[name][:, :300][:, order] == expected[name]).mean()
        assert same > 0.995, (name, same)
