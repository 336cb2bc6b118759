"""Rotations of Gaussians: normal form, turns, and the choice among the 24 equal forms of one Gaussian; and SH that are turned."""

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE, SH_C1, SH_C2, SH_C3, SH_C4
from flexgs_edge.errors import InputError
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.small_matrices import product, quaternion_product, rotation_matrix

_DIRECTIONS = 60  # Directions in which functions are compared: many more than the 9 functions of the widest band
_DIGITS = 13  # Decimals of the matrices. Digits beyond them differ between processors.


def canonical_axes(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Permute and reverse the axes of Gaussians so that each rotation is as small as it can be.

    Covariances stay the same. The form changes from q to q p, where p is one of the 24 rotations of the cube, and the
    scales follow. The largest |w| among the 24 forms is the largest of three numbers: the largest component, the sum of
    the two largest over sqrt(2), and the sum of all four over 2. We use float64, basic operations and sqrt only.

    `quats`: [4, n], w x y z, any norm but zero. `log_scales`: [3, n]. Returns unit quaternions [4, n] f64 with w >=
    |x|, |y|, |z|, and their log-scales [3, n] in the input's dtype.
    """
    wide = np.asarray(quats, np.float64)
    largest = np.abs(wide).max(axis=0, initial=0)
    bad = np.flatnonzero(~((largest > 0) & np.isfinite(largest)))
    if len(bad):
        raise InputError(f"quats: {len(bad)} quaternions have no direction: use --drop-invalid")
    wide = wide / largest  # so that squares cannot overflow
    square = wide * wide
    norm = np.sqrt((square[0] + square[1]) + (square[2] + square[3]))
    wide /= norm
    back = _nearest_cube_rotation(wide) * np.array([[1.0], [-1.0], [-1.0], [-1.0]])
    turned = quaternion_product(wide, back)
    axes = np.argmax(np.abs(rotation_matrix(back)), axis=0)  # the old axis behind each new axis
    return turned * np.where(turned[0] < 0, -1.0, 1.0), np.take_along_axis(log_scales, axes, axis=0)


def turned(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """[3, n] f64, vectors ([3, n]) rotated by quaternions ([4, n], any norm but zero)."""
    wide = np.asarray(quats, np.float64)
    w, axis = wide[0], wide[1:]
    across = 2 * np.cross(axis, vectors, axis=0) / (wide * wide).sum(axis=0)
    return vectors + w * across + np.cross(axis, across, axis=0)


def matrices(quats: np.ndarray) -> np.ndarray:
    """[n, 3, 3] f64, rotation matrices of quaternions ([4, n], any norm but zero)."""
    columns = [turned(quats, np.broadcast_to(axis[:, None], (3, quats.shape[1]))) for axis in np.eye(3)]
    return np.stack(columns, axis=-1).transpose(1, 0, 2)


def quats_of(rotations: np.ndarray) -> np.ndarray:
    """[4, n] f64, unit quaternions of rotation matrices ([n, 3, 3] f64).

    Each is taken from the column of q q^T that belongs to its largest component, so that no digits are lost.
    """
    m = np.moveaxis(np.asarray(rotations, np.float64), 0, -1)
    outer = np.stack(
        [
            np.stack([1 + m[0, 0] + m[1, 1] + m[2, 2], m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]]),
            np.stack([m[2, 1] - m[1, 2], 1 + m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0]]),
            np.stack([m[0, 2] - m[2, 0], m[1, 0] + m[0, 1], 1 - m[0, 0] + m[1, 1] - m[2, 2], m[2, 1] + m[1, 2]]),
            np.stack([m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], 1 - m[0, 0] - m[1, 1] + m[2, 2]]),
        ]
    )
    largest = np.argmax(np.einsum("iin->in", outer), axis=0)
    quats = np.take_along_axis(outer, largest[None, None], axis=0)[0]
    return quats / np.sqrt((quats * quats).sum(axis=0))


def times(first: np.ndarray, quats: np.ndarray) -> np.ndarray:
    """[4, n] f64, quaternions ([4, n]) turned by one more rotation, the unit quaternion `first` ([4])."""
    w, x, y, z = np.asarray(first, np.float64)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return product(left, np.asarray(quats, np.float64))


def tilted(quats: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """[4, n] f64, unit quaternions ([4, n]) after small turns about their own axes.

    `errors` [3, n] are the vector parts of the turns.
    """
    unit = np.asarray(quats, np.float64)
    unit = unit / np.sqrt((unit * unit).sum(axis=0))
    return quaternion_product(unit, np.stack([np.sqrt(1 - (errors * errors).sum(axis=0)), *errors]))


def _nearest_cube_rotation(quats: np.ndarray) -> np.ndarray:
    """[4, n] f64, the rotation u of the cube with the largest product u . q."""
    size = np.abs(quats)
    sign = np.where(quats < 0, -1.0, 1.0)
    places = np.argsort(-size, axis=0, kind="stable")
    ordered = np.take_along_axis(size, places, axis=0)
    half = np.sqrt(0.5)
    one, two = ordered[0], (ordered[0] + ordered[1]) * half
    four = ((ordered[0] + ordered[1]) + (ordered[2] + ordered[3])) * 0.5
    weights = np.zeros_like(quats)
    np.put_along_axis(weights, places[:1], 1.0, axis=0)
    pairs = (two > one) & (two >= four)
    pair_weights = np.zeros_like(quats)
    np.put_along_axis(pair_weights, places[:2], half, axis=0)
    weights[:, pairs] = pair_weights[:, pairs]
    weights[:, (four > one) & (four > two)] = 0.5
    return weights * sign


def normalize_quats(quats: np.ndarray) -> np.ndarray:
    """Unit quaternions with w >= 0, the form that files hold.

    q / sqrt((w^2 + x^2) + (y^2 + z^2)) in float64, with all four signs changed if w < 0, rounded to float32 once.

    `quats`: [4, n] f32, w x y z, none of them zero. Returns [4, n] f32.
    """
    wide = quats.astype(np.float64)
    square = wide * wide
    norm = np.sqrt((square[0] + square[1]) + (square[2] + square[3]))
    zero = np.flatnonzero(norm == 0)
    if len(zero):
        raise InputError(f"quats: {len(zero)} quaternions are zero and have no direction: use --drop-invalid")
    wide /= np.where(wide[0] < 0, -norm, norm)
    return wide.astype(np.float32)


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
