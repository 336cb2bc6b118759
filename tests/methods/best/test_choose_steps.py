"""Grid steps of equal slope: the formulas, and how steps follow a scene's units."""

from __future__ import annotations

import math
from dataclasses import asdict

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import SH_C0
from flexgs_edge.grid.step_sizes import StepSizes, holdable
from flexgs_edge.methods.best.choose_steps import GEOMETRY, Slopes, choose_steps, probe_slopes, reachable
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, random_scene

SLOPES = Slopes({"position": 900.0, "scale": 5.0, "rotation": 8.0, "opacity": 0.7})
WEIGHT2 = np.array([4.0, 1.0, 0.5, 2.5])
DEGREES = np.array([0, 1, 2, 2])


def steps_at(multiplier: float, weight2: np.ndarray = WEIGHT2, slopes: Slopes = SLOPES) -> StepSizes:
    return choose_steps(slopes, weight2, DEGREES, 2, multiplier)


def numbers(steps: StepSizes) -> np.ndarray:
    return np.array([*(getattr(steps, kind) for kind in GEOMETRY), steps.dc, *steps.sh])


def test_doubling_the_multiplier_scales_every_step_by_root_two() -> None:
    np.testing.assert_allclose(numbers(steps_at(2e-3)) / numbers(steps_at(1e-3)), math.sqrt(2), rtol=1e-6)
    assert steps_at(1e-3).chroma == steps_at(2e-3).chroma > 1


def test_multipliers_beyond_all_sense_give_steps_that_a_grid_can_have() -> None:
    assert numbers(steps_at(1e60)).max() < 2.0**80


def test_slopes_are_equal_at_the_chosen_steps() -> None:
    """With an error of slope s a row and squared step d^2 and bits of -n log2 d a row: the multiplier is dE / dbits."""
    multiplier = 1e-3
    steps = steps_at(multiplier)
    rates = [
        2 * math.log(2) * SLOPES.per_row[kind] * getattr(steps, kind) ** 2 / GEOMETRY[kind][1] for kind in GEOMETRY
    ]
    np.testing.assert_allclose(rates, rates[0], rtol=1e-5)
    # Colours: 3 w2 (Y e)^2 with e^2 = d^2 / 12 and Y the constant's; one value of luma for a row.
    for step, rows in ((steps.dc, WEIGHT2), (steps.sh[0], WEIGHT2[1:]), (steps.sh[1], WEIGHT2[2:])):
        rate = 2 * math.log(2) * 3 * SH_C0**2 * rows.mean() / 12 * step**2
        assert rate == pytest.approx(multiplier, rel=1e-5)


def test_steeper_kinds_get_finer_steps() -> None:
    steep = Slopes({**SLOPES.per_row, "scale": 20.0})
    assert steps_at(1e-3, slopes=steep).scale == pytest.approx(steps_at(1e-3).scale / 2, rel=1e-6)
    assert steps_at(1e-3, 4 * WEIGHT2).dc == pytest.approx(steps_at(1e-3).dc / 2, rel=1e-6)
    assert steps_at(1e-3, 4 * WEIGHT2).position == steps_at(1e-3).position


def test_degrees_that_nobody_keeps_and_rows_that_nobody_sees() -> None:
    steps = choose_steps(SLOPES, WEIGHT2, np.zeros(4, np.uint8), 3, 1e-3)
    assert len(steps.sh) == 3 and np.isfinite(numbers(steps)).all()
    for weight2, degrees in ((np.zeros(2), np.zeros(2)), (np.zeros(0), np.zeros(0))):
        assert np.isfinite(numbers(choose_steps(SLOPES, weight2, degrees, 0, 1e-3))).all()
    flat = Slopes(dict.fromkeys(GEOMETRY, 0.0))
    assert (numbers(choose_steps(flat, WEIGHT2, DEGREES, 2, 1e-3)) > 0).all()


def views(scale: float = 1.0) -> list[Camera]:
    cameras = []
    for seed in range(3):
        rotation, translation = look_from(seed)
        moved = (scale * translation[0], scale * translation[1], scale * translation[2])
        cameras.append(make_camera(45, 37, rotation=rotation, translation=moved))
    return cameras


def scene(scale: float = 1.0, degree: int = 1) -> dict[str, np.ndarray]:
    planes = random_scene(150, 71, degree, size=-1.8).read(slice(0, 150), list(FIELD))
    planes["means"] *= np.float32(scale)
    planes["log_scales"] += np.float32(math.log(scale))
    return planes


def probe(planes: dict[str, np.ndarray], cameras: list[Camera], near: float = 0.2, most: int = 8) -> Slopes:
    renderer = Renderer(open_form("w16"), large_budget(), near)
    found = probe_slopes(renderer, planes, np.zeros(3), cameras, most)
    renderer.release()
    return found


def test_steps_follow_the_units_of_the_scene() -> None:
    """A scene a hundred times as large gets position steps a hundred times as large, and no others."""
    small, large = probe(scene(), views()), probe(scene(100.0), views(100.0), near=20.0)
    assert all(slope > 0 for slope in small.per_row.values())
    one, two = steps_at(1e-3, slopes=small), steps_at(1e-3, slopes=large)
    assert two.position == pytest.approx(100 * one.position, rel=0.02)
    for kind in ("scale", "rotation", "opacity"):
        # Log-scales of both scenes lie otherwise on the trial grid: the same only in the mean.
        assert getattr(two, kind) == pytest.approx(getattr(one, kind), rel=0.1)


def test_probing_is_deterministic_and_leaves_the_scene_alone() -> None:
    planes = scene()
    copies = {name: values.copy() for name, values in planes.items()}
    assert asdict(probe(planes, views())) == asdict(probe(planes, views()))
    for name, values in copies.items():
        np.testing.assert_array_equal(planes[name], values)


def test_slopes_count_all_poses_though_few_are_drawn() -> None:
    cameras = [camera for camera in views() for _ in range(2)]
    every = probe(scene(), cameras)
    some = probe(scene(), cameras, most=3)
    for kind in GEOMETRY:
        assert some.per_row[kind] == pytest.approx(every.per_row[kind], rel=1e-6)


def test_a_slope_predicts_the_error_of_a_step() -> None:
    """Squared error of a grid that is finer than the trial one: within what a parabola may miss."""
    planes, cameras = scene(), views()
    slopes = probe(planes, cameras)
    renderer = Renderer(open_form("w16"), large_budget())
    images = []
    step = np.float32(0.05)
    for opacity in (planes["opacity_logits"], (np.rint(planes["opacity_logits"] / step) * step).astype(np.float32)):
        with renderer.load(MemorySource({**planes, "opacity_logits": opacity})) as loaded:
            images.append([renderer.render(loaded, camera).astype(np.float64) for camera in cameras])
    error = sum(float(((a - b) ** 2).sum()) for a, b in zip(*images, strict=True))
    assert error == pytest.approx(slopes.per_row["opacity"] * 150 * 0.05**2, rel=0.6)


def test_far_rows_that_nobody_sees_are_out_of_reach() -> None:
    planes = {name: values.copy() for name, values in scene().items()}
    steps = steps_at(1e-3, slopes=probe(planes, views()))
    seen = np.ones(planes["means"].shape[1], bool)
    assert reachable(steps, planes, seen).all()
    planes["means"][0, 3] = 1e7 * steps.position
    planes["sh_dc"][1, 4] = 1e8 * steps.dc
    planes["opacity_logits"][0, 5] = -1e8 * steps.opacity
    # What is seen stays: positions are contracted, and other steps grow. The same unseen goes, and the grid is as it was.
    held = holdable(steps, planes)
    assert reachable(steps, planes, seen).all() and held.contraction is not None
    assert held.position == steps.position and held.opacity > 4 * steps.opacity
    seen[:6] = False
    keep = reachable(steps, planes, seen)
    assert np.flatnonzero(~keep).tolist() == [3, 4, 5]
    assert holdable(steps, {name: values[:, keep] for name, values in planes.items()}) == steps
    assert reachable(steps, planes, np.zeros_like(seen)).all()
