"""Contracted positions: near ones stay, far ones keep an error in proportion to their distance, in both containers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import educational_decoder
import educational_decoder2
from benchmarks.quantize import dequantized
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.sections import HeaderError, checked_contraction
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.grid.step_sizes import StepSizes, position_grid
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.packed.quantize import QuantizedScene, far_contraction, quantize_scene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.contraction import LARGEST, Contraction, densest
from flexgs_edge.scene.source import MemorySource
from grid_scenes import make_planes
from kernel_fixtures import large_budget, open_form
from synthetic import make_camera

STEP = 0.01
STEPS = StepSizes(STEP, 0.25, 0.05, 0.4, 0.1, (0.2,))
FINE = BitSpec(xyz=16, dc=16, scale=16, rot=16, opacity=16, rest=16)
FAR = 40


def far_planes(distance: float, count: int = 3000) -> dict[str, np.ndarray]:
    """Gaussians around (5, 0, 0), of which every 75th lies far away, on all sides, at distances up to `distance`."""
    planes = make_planes(count, 1, 3)
    rng = np.random.default_rng(4)
    planes["means"] = (rng.normal(0, 1, (3, count)) + np.array([[5], [0], [0]])).astype(np.float32)
    planes["log_scales"][:] = np.log(0.02)
    rows = np.arange(0, count, count // FAR)
    away = rng.normal(0, 1, (3, len(rows)))
    planes["means"][:, rows] = away / np.linalg.norm(away, axis=0) * np.geomspace(distance / 1e3, distance, len(rows))
    return planes


@pytest.mark.parametrize("radius", [1e-30, 0.3, 7.0, 1e30])
@pytest.mark.parametrize("largest", [1.0, 1e4, 1e20, 1e37])
def test_expanding_undoes_contracting(radius: float, largest: float) -> None:
    rng = np.random.default_rng(1)
    means = (rng.choice([-1.0, 1.0], (3, 500)) * np.geomspace(1e-3, 1, 500) * largest).astype(np.float32)
    contraction = Contraction((0.25, -3.0, 1e-4), radius)
    contracted = contraction.contract(means)
    away = np.abs(means - np.array(contraction.centre)[:, None]).max(axis=0)
    inside = away <= radius
    assert np.array_equal(contracted[:, inside], means[:, inside])
    back = contraction.expand(contracted.astype(np.float32))
    assert back.dtype == np.float32 and np.array_equal(back[:, inside], means[:, inside])
    # An error of float32 at the contracted place, of at most 64 octaves, grows with the distance, and no more.
    reached = away / radius < 2.0**63
    octaves = np.maximum(np.log2(np.maximum(away / radius, 1)), 1) + np.abs(contraction.centre).max() / radius + 2
    error = np.abs(back.astype(np.float64) - means).max(axis=0) / np.maximum(away, radius)
    assert (error <= 2.0**-23 * octaves)[reached].all()


def test_far_from_all_octaves_values_stay_finite() -> None:
    means = np.array([[3e38, -3e38, 1.0], [0.0, 3e38, 0.0], [1.0, 2.0, 3.0]], np.float32)
    back = Contraction((LARGEST, 0.0, -LARGEST), 1 / LARGEST).expand(means)
    assert np.isfinite(back).all() and np.abs(back).max() <= LARGEST


def test_the_densest_place_is_not_moved_by_a_sky() -> None:
    rng = np.random.default_rng(2)
    sky = rng.normal(0, 1, (3, 6000))
    sky = 4000 * np.abs(sky) / np.linalg.norm(sky, axis=0)  # on one side
    means = np.concatenate([rng.normal(0, 1, (3, 4000)) + 7, sky], axis=1)[:, rng.permutation(10_000)]
    assert np.abs(densest(means) - 7).max() < 1


@pytest.mark.parametrize("distance", [3e4, 3e6, 2e7, 1e15])
def test_a_grid_holds_far_positions_without_a_coarser_step(distance: float) -> None:
    planes = far_planes(distance)
    step, contraction = position_grid(planes["means"], STEP)
    assert step == STEP and contraction is not None
    steps = replace(STEPS, contraction=contraction)
    grid, order = to_grid(planes, np.zeros(3000), steps, np.zeros(3))
    means, back = planes["means"][:, order].astype(np.float64), from_grid(grid)["means"]
    away = np.abs(means - np.array(contraction.centre)[:, None]).max(axis=0)
    error = np.abs(back - means).max(axis=0)
    assert (error <= STEP * 0.51 * np.maximum(away / contraction.radius, 1) + 2.0**-23 * away).all()
    # Directions are kept to less than a tenth of a pixel of a view of 4000 pixels.
    assert (error / np.maximum(away, contraction.radius)).max() < 0.1 / 2000


def test_scenes_that_fit_a_grid_are_not_contracted() -> None:
    means = far_planes(1e3)["means"]
    assert position_grid(means, STEP) == (STEP, None)
    assert position_grid(means[:, :0], STEP) == (STEP, None)


def test_steps_with_a_contraction_go_through_json() -> None:
    planes = far_planes(3e6)
    steps = replace(STEPS, contraction=position_grid(planes["means"], STEP)[1])
    assert StepSizes.from_json(json.loads(json.dumps(steps.to_json()))) == steps
    assert "contraction" not in STEPS.to_json()


def contracted_grid(count: int) -> GridScene:
    planes = far_planes(3e6, count)
    contraction = position_grid(planes["means"], STEP)[1]
    return to_grid(planes, np.arange(count) % 2, replace(STEPS, contraction=contraction), (1.0, 2.0, 3.0))[0]


def test_every_decoder_of_version_2_reads_the_same(tmp_path: Path) -> None:
    grid, path = contracted_grid(300), tmp_path / "a.fgs"
    write_grid(path, grid, {})
    source, expected = open_fgs(path), from_grid(grid)
    assert np.abs(expected["means"]).max() > 1e6
    np.testing.assert_array_equal(source.read(slice(0, 300), ["means"])["means"], expected["means"])
    np.testing.assert_array_equal(educational_decoder2.decode(path.read_bytes())[1]["means"], expected["means"])
    table = np.empty((300, 17 + 9), np.float32)
    assert isinstance(source, GridSource)
    with source.on_device(open_form("w16"), 1):
        np.testing.assert_array_equal(source.read_table(slice(0, 300), table)[:, :3].T, expected["means"])


def packed(planes: dict[str, np.ndarray]) -> tuple[MemorySource, QuantizedScene]:
    source = MemorySource(planes)
    rows = np.arange(source.count)
    return source, quantize_scene(source, rows[::2], rows[1::2], FINE, contraction=far_contraction(source))


@pytest.mark.parametrize("distance", [3e4, 3e6, 2e7])
def test_far_rows_leave_the_others_of_version_1_their_precision(distance: float, tmp_path: Path) -> None:
    planes, path = far_planes(distance), tmp_path / "a.fgs"
    _, quantized = packed(planes)
    assert quantized.contraction is not None
    write_container(path, quantized, {})
    back = open_fgs(path).read(slice(0, 3000), ["means"])["means"].astype(np.float64)
    np.testing.assert_array_equal(back, educational_decoder.decode(path.read_bytes())[1]["means"])
    # Rows come in another order, so we compare with the nearest.
    for place in back.T:
        assert np.abs(planes["means"].T - place).max(axis=1).min() < max(1e-3 * np.abs(place).max(), 0.002)


def test_contracted_codes_are_drawn_as_their_values(tmp_path: Path) -> None:
    _, quantized = packed(far_planes(3e6))
    renderer, camera = Renderer(open_form("w16"), large_budget()), make_camera(48, 32)
    with renderer.load_quantized(quantized) as scene:
        drawn = renderer.render(scene, camera)
    with renderer.load(dequantized(quantized)) as scene:
        np.testing.assert_array_equal(drawn, renderer.render(scene, camera))


def test_scenes_without_far_rows_need_no_contraction() -> None:
    planes = far_planes(3e4)
    planes["means"] = np.clip(planes["means"], -50, 50)
    source, quantized = packed(planes)
    assert far_contraction(source) is None and quantized.contraction is None


@pytest.mark.parametrize(
    "value",
    [None, {"centre": [0.0, 0.0, 0.0]}, {"centre": [0.0, 0.0], "radius": 1.0}, {"centre": [0, 0.0, 0.0], "radius": 1.0}]
    + [{"centre": [0.0, 0.0, 1e39], "radius": 1.0}]
    + [{"centre": [0.0, 0.0, 0.0], "radius": radius} for radius in (0.0, -1.0, 1e-39, 1e39, 1, "1")],
)
def test_headers_with_other_contractions_are_refused(value: object) -> None:
    with pytest.raises(HeaderError, match="contraction: wanted"):
        checked_contraction(value)
