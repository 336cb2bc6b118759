"""The check before work starts: every kind of bad value, one at a time."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.errors import InputError
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource

ALL = [field.name for field in FIELDS]


def arrays(count: int = 11, degree: int = 1) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(5)
    return {f.name: rng.normal(size=(f.width(degree), count)).astype(np.float32) for f in FIELDS}


@pytest.mark.parametrize("chunk_rows", [1, 4, 11, 100])
def test_a_good_scene_comes_back_as_it_is(chunk_rows: int) -> None:
    source = MemorySource(arrays())
    assert check_scene(source, chunk_rows=chunk_rows) is source


def test_an_empty_scene_is_refused() -> None:
    with pytest.raises(InputError, match="memory: the scene is empty"):
        check_scene(MemorySource(arrays(0)))


@pytest.mark.parametrize(
    ("field", "value"),
    # Log-scales of -inf are flat splats: valid.
    [(f, v) for f in ALL for v in (np.nan, np.inf, -np.inf) if (f, v) != ("log_scales", -np.inf)],
)
@pytest.mark.parametrize("chunk_rows", [3, 64])
def test_a_bad_value_is_named_and_can_be_dropped(field: str, value: float, chunk_rows: int) -> None:
    data = arrays()
    data[field][-1, [4, 9]] = value
    source = MemorySource(data)
    words = rf"2 of 11 Gaussians are invalid: NaN or infinity in {field} in 2 \(first row 4\); use --drop-invalid"
    with pytest.raises(InputError, match=words):
        check_scene(source, chunk_rows=chunk_rows)
    kept = check_scene(source, drop_invalid=True, chunk_rows=chunk_rows)
    assert kept.count == 9
    assert kept.notes[0].startswith("2 of 11 Gaussians left out as invalid: NaN or infinity in " + field)
    rows = np.delete(np.arange(11), [4, 9])
    for name, plane in kept.read(slice(0, 9), ALL).items():
        np.testing.assert_array_equal(plane, data[name][:, rows])


def test_a_row_with_two_faults_counts_once() -> None:
    data = arrays()
    data["means"][:, 2] = np.nan
    data["quats"][0, 2] = np.inf
    with pytest.raises(InputError, match=r"1 of 11 Gaussians are invalid: .* means in 1 .* quats in 1 "):
        check_scene(MemorySource(data))


@pytest.mark.parametrize("field", ["sh_dc", "sh_rest"])
def test_coefficients_whose_squares_leave_float32(field: str) -> None:
    data = arrays()
    data[field][-1, [2, 7]] = (1.1e15, -3e38)
    data[field][0, 3] = -9.9e14
    words = rf"2 of 11 Gaussians .* beyond \+-1e\+15 in {field} in 2 \(first row 2\)"
    with pytest.raises(InputError, match=words):
        check_scene(MemorySource(data))
    assert check_scene(MemorySource(data), drop_invalid=True).count == 9


@pytest.mark.parametrize("value", [0.0, -0.0, 1e-25, 1e-42, 3e19])
def test_quaternions_that_cannot_be_normalised(value: float) -> None:
    data = arrays()
    data["quats"][:, 7] = value
    with pytest.raises(InputError, match=r"quats of norm zero \(or beyond float32\) in 1 \(first row 7\)"):
        check_scene(MemorySource(data))
    assert check_scene(MemorySource(data), drop_invalid=True).count == 10


@pytest.mark.parametrize("value", [1e-18, 1e18])
def test_quaternions_of_any_norm_that_float32_can_handle_are_valid(value: float) -> None:
    data = arrays()
    data["quats"][:, 7] = value
    assert check_scene(MemorySource(data)).count == 11


def test_everything_invalid() -> None:
    data = arrays(3)
    data["means"][:] = np.nan
    with pytest.raises(InputError, match="all 3 Gaussians are invalid"):
        check_scene(MemorySource(data), drop_invalid=True)


@pytest.mark.parametrize("chunk_rows", [2, 64])
def test_flat_splats_take_the_smallest_finite_scale(chunk_rows: int) -> None:
    data = arrays()
    data["log_scales"][0, [1, 8]] = -np.inf
    data["log_scales"][2, 1] = -np.inf
    smallest = data["log_scales"][np.isfinite(data["log_scales"])].min()
    source = check_scene(MemorySource(data, origin=[1.0, 2.0, 3.0]), chunk_rows=chunk_rows)
    assert source.notes == (
        f"2 flat Gaussians: log-scales of -inf set to the smallest finite one, {float(smallest):.4g}",
    )
    read = source.read(slice(0, 11), ["log_scales", "means"])
    np.testing.assert_array_equal(read["log_scales"], np.maximum(data["log_scales"], smallest))
    np.testing.assert_array_equal(read["means"], data["means"])
    np.testing.assert_array_equal(source.origin, [1.0, 2.0, 3.0])
    assert data["log_scales"][0, 1] == -np.inf, "the input was changed"
    np.testing.assert_array_equal(
        source.select(np.array([8, 1])).read(slice(0, 2), ["log_scales"])["log_scales"], read["log_scales"][:, [8, 1]]
    )


def test_the_smallest_scale_is_taken_from_the_rows_that_stay() -> None:
    data = arrays()
    data["log_scales"][0, 1] = -np.inf
    data["log_scales"][0, 5] = -50.0
    data["means"][0, 5] = np.nan
    source = check_scene(MemorySource(data), drop_invalid=True)
    assert len(source.notes) == 2
    assert source.read(slice(0, 10), ["log_scales"])["log_scales"].min() > -10.0


def test_only_flat_scales() -> None:
    data = arrays(2)
    data["log_scales"][:] = -np.inf
    with pytest.raises(InputError, match="log_scales: all are -inf"):
        check_scene(MemorySource(data))


def test_sh_count_survives_dropping() -> None:
    data = arrays()
    data["sh_rest"][:, 6:] = 0.0
    data["means"][0, [0, 8]] = np.nan
    assert check_scene(MemorySource(data, sh_count=6), drop_invalid=True).sh_count == 5
