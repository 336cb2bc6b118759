"""Products and inverses of small matrices, with the same bits on every processor.

BLAS, behind `@` and `numpy.linalg`, adds in another order on other processors. One bit of a camera's place can decide which of
two equally near neighbours it has, and with it every byte of a file.
"""

from __future__ import annotations

import numpy as np

_MOST_STEPS = 60
"""Steps halve large singular values, then square the distance from 1. So 60 are enough for 1e-12 of the largest."""
_SMALL_STEP = 1e-12  # A smaller step leaves an error of less than its square, which no digit shows


def product(matrix: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """[m, ...], the matrix product of `matrix` [m, k] and `columns` [k, ...], added up in order.

    >>> product(np.array([[0.0, 2.0], [1.0, 0.0]]), np.array([3.0, 4.0]))
    array([8., 3.])
    """
    found: np.ndarray = sum(
        matrix[:, k].reshape(-1, *[1] * (columns.ndim - 1)) * columns[k][None] for k in range(len(columns))
    )
    return found


def inverse(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] f64, the inverse of a matrix [3, 3]; not finite if it has none.

    >>> inverse(np.diag([1.0, 2.0, 4.0]))
    array([[1.  , 0.  , 0.  ],
           [0.  , 0.5 , 0.  ],
           [0.  , 0.  , 0.25]])
    """
    first, second, third = np.asarray(matrix, np.float64)
    columns = np.stack([np.cross(second, third), np.cross(third, first), np.cross(first, second)], axis=1)
    with np.errstate(all="ignore"):
        found: np.ndarray = columns / (first * columns[:, 0]).sum()
    return found


def nearest_rotation(matrix: np.ndarray) -> np.ndarray:
    """[3, 3] f64, the orthogonal matrix nearest to `matrix`, by Newton's iteration; not finite if the matrix has no inverse."""
    found = np.asarray(matrix, np.float64)
    for _ in range(_MOST_STEPS):
        before, found = found, (found + inverse(found).T) / 2
        if not np.abs(found - before).max() > _SMALL_STEP:
            break
    return found
