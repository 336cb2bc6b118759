"""SH of turned and mirrored Gaussians show in each direction what they showed before the turn."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.kernels.twins.project import sh_basis
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.rotations import band_matrices, matrices, quats_of, sh_functions, times, turn_sh
from flexgs_edge.small_matrices import product


def some_rotations(count: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    quats = np.random.default_rng(seed).normal(size=(4, count))
    quats /= np.linalg.norm(quats, axis=0)
    return quats, matrices(quats)


def some_directions(count: int = 50) -> np.ndarray:
    directions = np.random.default_rng(9).normal(size=(3, count))
    return directions / np.linalg.norm(directions, axis=0)


def test_functions_are_those_of_the_renderer() -> None:
    directions = some_directions()
    expected = np.stack(sh_basis(4, *directions.astype(np.float32)))
    np.testing.assert_allclose(sh_functions(4, directions), expected, atol=2e-6)
    assert sh_functions(0, directions).shape == (0, 50)


@pytest.mark.parametrize("mirror", [1, -1])
@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_colours_turn_with_the_gaussian(degree: int, mirror: int) -> None:
    coefficients = np.random.default_rng(degree).normal(size=(3, sh_rest_count(degree), 4))
    directions = some_directions()
    for turn in some_rotations(5)[1] * mirror:
        turned = turn_sh(coefficients.reshape(-1, 4), band_matrices(turn, degree)).reshape(coefficients.shape)
        before = np.einsum("ckn,kd->cnd", coefficients, sh_functions(degree, turn.T @ directions))
        after = np.einsum("ckn,kd->cnd", turned, sh_functions(degree, directions))
        np.testing.assert_allclose(after, before, atol=1e-12)


def test_matrices_of_four_bands_turn_fewer() -> None:
    values = np.random.default_rng(0).normal(size=(9, 2))
    bands = band_matrices(some_rotations(1)[1][0])
    np.testing.assert_array_equal(turn_sh(values, bands), turn_sh(values, bands[:1]))
    assert turn_sh(np.zeros((0, 5)), bands).shape == (0, 5)


def test_quaternions_and_matrices_are_each_others() -> None:
    quats, found = some_rotations(200)
    # Half turns, where three of the four components are zero.
    quats = np.concatenate([quats, np.eye(4), -np.eye(4)], axis=1)
    found = matrices(quats)
    np.testing.assert_allclose(np.abs((quats_of(found) * quats).sum(axis=0)), 1, atol=1e-14)
    np.testing.assert_allclose(matrices(3 * quats), found, atol=1e-14)
    np.testing.assert_allclose(matrices(times(quats[:, 0], quats)), found[0] @ found, atol=1e-14)


def test_a_turn_never_depends_on_the_number_of_columns() -> None:
    rng = np.random.default_rng(1)
    matrix, values = rng.normal(size=(4, 4)), rng.normal(size=(4, 37))
    whole = product(matrix, values)
    np.testing.assert_allclose(whole, matrix @ values, atol=1e-14)
    for at in range(37):
        np.testing.assert_array_equal(product(matrix, values[:, at : at + 1])[:, 0], whole[:, at])
