"""Values on grids: errors within half a step, equal covariances, exact formulas, refusals."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import lowered, recolour, to_grid
from flexgs_edge.scene.curve import morton
from flexgs_edge.scene.rotations import canonical_axes
from grid_scenes import STEPS, make_grid, make_planes


def rotations(quats: np.ndarray) -> np.ndarray:
    w, x, y, z = quats / np.linalg.norm(quats, axis=0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)


def covariances(quats: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    axes = rotations(quats.astype(np.float64)) * np.exp(log_scales.astype(np.float64)).T[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def test_canonical_axes_keep_the_covariance_and_turn_least() -> None:
    rng = np.random.default_rng(0)
    quats, scales = rng.normal(size=(4, 4000)) * rng.lognormal(size=4000), rng.normal(size=(3, 4000))
    quats[:, :8] = np.array([[1, 1, 1, 1], [1, -1, 1, -1], [1, 1, 0, 0], [0, 0, -1, 1]] * 2).T
    turned, renamed = canonical_axes(quats, scales)
    np.testing.assert_allclose(covariances(turned, renamed), covariances(quats, scales), rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose((turned**2).sum(axis=0), 1, rtol=1e-12)
    # 62.8 degrees is the farthest that any rotation is from one of the cube's 24.
    assert turned[0].min() >= np.cos(np.radians(62.8 / 2)) - 1e-4
    again, scales_again = canonical_axes(turned, renamed)
    np.testing.assert_allclose(np.abs((again * turned).sum(axis=0))[8:], 1, rtol=1e-12)
    np.testing.assert_array_equal(scales_again[:, 8:], renamed[:, 8:])


@pytest.mark.parametrize("bad", [0.0, np.nan, np.inf])
def test_quaternions_without_direction(bad: float) -> None:
    with pytest.raises(InputError, match="1 quaternions have no direction"):
        canonical_axes(np.array([[1.0, bad], [0, bad], [0, bad], [0, bad]]), np.zeros((3, 2)))


@pytest.mark.parametrize("count", [0, 1, 2, 333])
def test_errors_within_half_a_step(count: int) -> None:
    planes = make_planes(count, 3)
    degrees = np.random.default_rng(1).integers(0, 4, count)
    grid, order = to_grid(planes, degrees, STEPS, (1, 2, 3))
    back = from_grid(grid)
    assert sorted(order.tolist()) == list(range(count))
    for name, step in (("means", STEPS.position), ("opacity_logits", STEPS.opacity)):
        assert np.abs(back[name] - planes[name][:, order]).max(initial=0) <= step * 0.5001
    colour = np.abs(back["sh_dc"] - planes["sh_dc"][:, order]).max(initial=0)
    assert colour <= STEPS.dc * (0.5 + 0.25 * 2 * STEPS.chroma) * 1.001
    if count:
        top = grid.sh_degree
        rest = planes["sh_rest"].reshape(3, 15, count)[:, : (top + 1) ** 2 - 1, order]
        got = back["sh_rest"].reshape(3, (top + 1) ** 2 - 1, count)
        for degree in range(1, top + 1):
            band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
            has = degrees[order] >= degree
            error = np.abs(got - rest)[:, band][..., has].max(initial=0)
            assert error <= STEPS.sh[degree - 1] * (0.5 + 0.25 * 2 * STEPS.chroma) * 1.001
            assert not got[:, band][..., ~has].any()


def test_rows_lie_along_the_curve_layer_by_layer() -> None:
    grid = make_grid(500, layers=3)
    index = morton(grid.position - grid.position.min(axis=1, keepdims=True))
    steps = np.diff(grid.layer.astype(int))
    assert (steps >= 0).all() and (steps > 0).sum() == 2
    assert (index[1:] >= index[:-1])[steps == 0].all()


def test_ties_keep_their_order() -> None:
    planes = make_planes(50, 0)
    planes["means"][:] = 1
    np.testing.assert_array_equal(to_grid(planes, np.zeros(50), STEPS, np.zeros(3))[1], np.arange(50))


def test_values_by_the_written_formula() -> None:
    grid = make_grid(200, 2)
    back = from_grid(grid)
    f32 = np.float32
    for row in range(0, 200, 7):
        x, y, z = (f32(int(code)) * f32(STEPS.rotation) for code in grid.rotation[:, row])
        w = np.sqrt(max(f32(0), f32(1) - ((x * x + y * y) + z * z)))
        assert back["quats"][:, row].tolist() == [w, x, y, z]
        chroma = f32(STEPS.dc) * f32(STEPS.chroma)
        luma, orange, green = f32(grid.dc[0, row]) * f32(STEPS.dc), *(f32(c) * chroma for c in grid.dc[1:, row])
        rest = luma - green * f32(0.5)
        colour = [rest + orange * f32(0.5), luma + green * f32(0.5), rest - orange * f32(0.5)]
        assert back["sh_dc"][:, row].tolist() == colour


def test_some_rows_and_fields() -> None:
    grid = make_grid(300, 3)
    everything = from_grid(grid)
    rows = np.array([0, 3, 50, 299])
    assert list(from_grid(grid, rows, ["quats"])) == ["quats"]
    for part in (from_grid(grid, rows), from_grid(grid.take(rows))):
        for name, plane in part.items():
            np.testing.assert_array_equal(plane, everything[name][: len(plane)][:, rows])


def test_a_second_trip_changes_nothing() -> None:
    grid = make_grid(400, 2, layers=2)
    back, order = to_grid(from_grid(grid), grid.sh_degrees, grid.step_sizes, grid.origin, grid.layer)
    np.testing.assert_array_equal(order, np.arange(400))
    for name in ("position", "opacity", "dc", "sh_degrees"):
        np.testing.assert_array_equal(getattr(back, name), getattr(grid, name))


@pytest.mark.parametrize("with_sh", [False, True])
def test_other_colours_on_the_same_steps(with_sh: bool) -> None:
    """They are the codes that a new grid of these colours has. Without SH, those of the old colours stay."""
    planes, degrees = make_planes(333, 2), np.random.default_rng(1).integers(0, 3, 333)
    grid, order = to_grid(planes, degrees, STEPS, (1, 2, 3))
    brighter = {name: 1.5 * planes[name] + np.float32(0.1) for name in ("sh_dc", "sh_rest")}
    wanted, _ = to_grid({**planes, **brighter}, degrees, STEPS, (1, 2, 3))
    found = recolour(grid, brighter["sh_dc"][:, order], brighter["sh_rest"][:, order] if with_sh else None)
    np.testing.assert_array_equal(found.dc, wanted.dc)
    assert (found.dc != grid.dc).any() and len(found.sh) == 2
    for bands in zip(found.sh, wanted.sh if with_sh else grid.sh, strict=True):
        np.testing.assert_array_equal(*bands)
    np.testing.assert_array_equal(found.position, grid.position)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("means", np.nan, "means: row 7"),
        ("means", 2e5, "means: the scene is .* position steps"),
        ("means", 1e9, "means: row 7: value 1e\\+09 at a step of 0.05"),
        ("opacity_logits", np.inf, "opacity_logits: row 7"),
        ("log_scales", -np.inf, "log_scales: row 7"),
        ("sh_dc", 1e30, "sh_dc: row 7"),
        ("sh_rest", np.nan, "sh_rest: row 7"),
    ],
)
def test_values_out_of_range(field: str, value: float, message: str) -> None:
    planes = make_planes(9, 1)
    planes[field][:, 7] = value
    with pytest.raises(InputError, match=message), np.errstate(invalid="ignore"):
        to_grid(planes, np.ones(9), STEPS, np.zeros(3))


@pytest.mark.parametrize(
    ("degrees", "layer", "message"),
    [
        (np.zeros(8), None, "sh_degrees: expected 9 rows"),
        (np.full(9, 5), None, "sh_degrees: row 0: expected 0 to 4, got 5"),
        (np.full(9, 2), None, "SH degree 2 asked for"),
        (np.zeros(9), np.full(9, 256), "layer: row 0: expected 0 to 255"),
    ],
)
def test_rows_that_do_not_fit(degrees: np.ndarray, layer: np.ndarray | None, message: str) -> None:
    with pytest.raises(InputError, match=message):
        to_grid(make_planes(9, 1), degrees, STEPS, np.zeros(3), layer)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf, 1e-30, 1e30])
def test_steps_out_of_range(value: float) -> None:
    with pytest.raises(InputError, match="step of scale: expected"):
        StepSizes(0.1, value, 0.1, 0.1, 0.1)


def test_steps_through_json() -> None:
    steps = StepSizes(0.1, 0.2, 0.3, 0.4, 0.5, (0.6, 0.7))
    assert steps.position == float(np.float32(0.1))
    assert StepSizes.from_json(json.loads(json.dumps(steps.to_json()))) == steps
    assert isinstance(make_grid(3), GridScene)


@pytest.mark.parametrize("zero_above", [0, 1, 2, 3])
def test_degrees_are_as_low_as_the_codes_allow(zero_above: int) -> None:
    """Rows whose highest SH codes are zero come back from a file without that degree: the file must not count it."""
    grid = make_grid(300, 3, 19)
    rows = np.random.default_rng(4).random(300) < 0.5
    bands = []
    for degree, codes in enumerate(grid.sh, start=1):
        codes = codes.copy()
        # Of some rows all codes above a degree, of others one band in the middle: that one stays.
        some = rows if degree > zero_above else ~rows if degree == 2 else np.zeros(300, bool)
        codes[:, some[grid.sh_degrees >= degree]] = 0
        bands.append(codes)
    grid = replace(grid, sh=tuple(bands))
    low = lowered(grid)
    assert (low.sh_degrees <= grid.sh_degrees).all() and low.sh_degrees[rows].max(initial=0) <= zero_above
    for degree, codes in enumerate(low.sh, start=1):
        # Every row has a code at its highest degree.
        assert codes[:, low.sh_degrees[low.sh_degrees >= degree] == degree].any(axis=0).all()
    before, after = (from_grid(some)["sh_rest"].reshape(3, -1, 300) for some in (grid, low))
    np.testing.assert_array_equal(after, before[:, : after.shape[1]])
    assert not before[:, after.shape[1] :].any()
