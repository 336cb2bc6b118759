"""Spherical harmonics of Gaussians that are turned: one matrix for each band of functions, for any rotation or mirror."""

from __future__ import annotations

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE, SH_C1, SH_C2, SH_C3, SH_C4
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.small_matrices import product

_DIRECTIONS = 60  # Directions in which functions are compared: many more than the 9 functions of the widest band
_DIGITS = 13  # Decimals of the matrices. Digits beyond them differ between processors.


def sh_functions(degree: int, directions: np.ndarray) -> np.ndarray:
    """[K, n] f64, SH functions above degree 0 in unit directions ([3, n]), in the order of INRIA's coefficients."""
    x, y, z = np.asarray(directions, np.float64)
    xx, yy, zz = x * x, y * y, z * z
    bands = (
        (-SH_C1 * y, SH_C1 * z, -SH_C1 * x),
        (x * y, y * z, 2 * zz - xx - yy, x * z, xx - yy),
        (
            *(y * (3 * xx - yy), x * y * z, y * (4 * zz - xx - yy), z * (2 * zz - 3 * xx - 3 * yy)),
            *(x * (4 * zz - xx - yy), z * (xx - yy), x * (xx - 3 * yy)),
        ),
        (
            *(x * y * (xx - yy), y * z * (3 * xx - yy), x * y * (7 * zz - 1), y * z * (7 * zz - 3)),
            *(zz * (35 * zz - 30) + 3, x * z * (7 * zz - 3), (xx - yy) * (7 * zz - 1), x * z * (xx - 3 * yy)),
            xx * (xx - 3 * yy) - yy * (3 * xx - yy),
        ),
    )
    factors = ((1.0,) * 3, SH_C2, SH_C3, SH_C4)
    rows = [
        factor * term
        for band, constants in zip(bands[:degree], factors, strict=False)
        for factor, term in zip(constants, band, strict=True)
    ]
    return np.stack(rows) if rows else np.zeros((0, len(x)))


def band_matrices(turn: np.ndarray, degree: int = MAX_SH_DEGREE) -> list[np.ndarray]:
    """Matrices that turn the coefficients of each band above degree 0.

    A turned Gaussian shows in direction d what it showed in direction `turn`^T d before. We write both as functions of
    many directions and solve for the coefficients; a band turns into itself, so that the solution is exact.

    `turn`: [3, 3] f64, orthogonal; mirrors are allowed.

    Returns [2 l + 1, 2 l + 1] f64 for l = 1 to `degree`: new coefficients from old ones.
    """
    directions = _spread(_DIRECTIONS)
    before, after = sh_functions(degree, product(turn.T, directions)), sh_functions(degree, directions)
    bands = [slice(sh_rest_count(band - 1), sh_rest_count(band)) for band in range(1, degree + 1)]
    return [np.linalg.lstsq(after[band].T, before[band].T, rcond=None)[0].round(_DIGITS) for band in bands]


def turn_sh(sh_rest: np.ndarray, matrices: list[np.ndarray]) -> np.ndarray:
    """[3 K, n] f64, SH ([3 K, n], channel by channel) after the turn of `band_matrices`."""
    channels = np.array(sh_rest, np.float64).reshape(3, len(sh_rest) // 3, sh_rest.shape[1])
    start = 0
    for matrix in matrices:
        band = slice(start, start + len(matrix))
        if band.stop > channels.shape[1]:
            break
        channels[:, band] = product(matrix, channels[:, band].swapaxes(0, 1)).swapaxes(0, 1)
        start = band.stop
    return channels.reshape(sh_rest.shape)


def _spread(count: int) -> np.ndarray:
    """[3, count] f64, unit directions along a spiral over the sphere."""
    at = np.arange(count) + 0.5
    z = 1 - 2 * at / count
    angle = np.pi * (1 + np.sqrt(5)) * at
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z])
