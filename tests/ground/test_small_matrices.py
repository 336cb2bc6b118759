"""Products and inverses of small matrices against NumPy's."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.small_matrices import inverse, nearest_rotation, product


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    left, _, right = np.linalg.svd(rng.normal(size=(3, 3)))
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right


@pytest.mark.parametrize("shape", [(3,), (3, 5), (3, 2, 4)])
def test_product(shape: tuple[int, ...]) -> None:
    rng = np.random.default_rng(1)
    matrix, columns = rng.normal(size=(4, 3)), rng.normal(size=shape)
    np.testing.assert_allclose(product(matrix, columns), np.tensordot(matrix, columns, 1), rtol=1e-12)


def test_a_column_alone_has_the_same_bits() -> None:
    rng = np.random.default_rng(2)
    matrix, columns = rng.normal(size=(3, 3)), rng.normal(size=(3, 1001))
    assert np.array_equal(product(matrix, columns[:, 7]), product(matrix, columns)[:, 7])


def test_inverse() -> None:
    matrix = np.random.default_rng(3).normal(size=(3, 3))
    np.testing.assert_allclose(inverse(matrix), np.linalg.inv(matrix), rtol=1e-10)
    assert not np.isfinite(inverse(np.diag([1.0, 1.0, 0.0]))).all()


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 40.0, 120.0, 179.9])
def test_nearest_rotation(degrees: float) -> None:
    """Of two rotations' sum it is the one half way between them, also where they are nearly half a turn apart."""
    rng = np.random.default_rng(4)
    first, frame = random_rotation(rng), random_rotation(rng)

    def turn(angle: float) -> np.ndarray:
        c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
        return frame.T @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ frame

    found = nearest_rotation(first + turn(degrees) @ first)
    np.testing.assert_allclose(found, turn(degrees / 2) @ first, atol=1e-9)


def test_no_rotation_is_nearest_to_a_singular_matrix() -> None:
    assert not np.isfinite(nearest_rotation(np.diag([0.0, 0.0, 2.0]))).all()
