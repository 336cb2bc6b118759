"""Products and inverses of small matrices, and quaternions, with the same bits on every processor.

BLAS, behind `@` and `numpy.linalg`, adds in another order on other processors. One bit of a camera's place can decide which of
two equally near neighbours it has, and with it every byte of a file.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

_MOST_STEPS = 60
"""Steps halve large singular values, then square the distance from 1. So 60 are enough for 1e-12 of the largest."""
_SMALL_STEP = 1e-12  # A smaller step leaves an error of less than its square, which no digit shows


def product(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """[m, ...], the matrix product of `matrix` [m, k] and `columns` [k, ...], added up in order.

    >>> product(np.array([[0.0, 2.0], [1.0, 0.0]]), np.array([3.0, 4.0]))
    array([8., 3.])
    """
    return sum(matrix[:, k].reshape(-1, *[1] * (columns.ndim - 1)) * columns[k][None] for k in range(len(columns)))


def inverse(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] f64, the inverse of a matrix [3, 3]; not finite if it has none.

    >>> inverse(np.diag([1.0, 2.0, 4.0]))
    array([[1.  , 0.  , 0.  ],
           [0.  , 0.5 , 0.  ],
           [0.  , 0.  , 0.25]])
    """
    first, second, third = np.asarray(matrix, np.float64)
    columns = np.stack([cross(second, third), cross(third, first), cross(first, second)], axis=1)
    with np.errstate(all="ignore"):
        found: np.ndarray = columns / (first * columns[:, 0]).sum()
    return found


def cross(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """[3] f64, the cross product, ten times as fast as `numpy.cross`."""
    (a, b, c), (d, e, f) = one.tolist(), other.tolist()
    return np.array([b * f - c * e, c * d - a * f, a * e - b * d])


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] f64, the orthogonal matrix nearest to `matrix`, by Newton's iteration; not finite if the matrix has no inverse."""
    found = np.asarray(matrix, np.float64)
    for _ in range(_MOST_STEPS):
        before, found = found, (found + inverse(found).T) / 2
        if not np.abs(found - before).max() > _SMALL_STEP:
            break
    return found


def rotation_matrix(quats: Sequence[Any] | np.ndarray) -> np.ndarray:
    """[3, 3, ...] f64, rotation matrices of unit quaternions w x y z ([4, ...])."""
    w, x, y, z = quats
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """[4, ...], products of quaternions w x y z ([4, ...])."""
    (w, x, y, z), (bw, bx, by, bz) = first, second
    return np.stack(
        [
            (w * bw - x * bx) - (y * by + z * bz),
            (w * bx + x * bw) + (y * bz - z * by),
            (w * by - x * bz) + (y * bw + z * bx),
            (w * bz + x * by) - (y * bx - z * bw),
        ]
    )
