"""Rotations of Gaussians: normal form, turns, and the choice among the 24 equal forms of one Gaussian."""

from __future__ import annotations

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.small_matrices import product


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
    best = _nearest_cube_rotation(wide)
    turned = _times_conjugate(wide, best)
    return turned * np.where(turned[0] < 0, -1.0, 1.0), np.take_along_axis(log_scales, _axes(best), axis=0)


def turned(quats: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """[3, n] f64, vectors ([3, n]) rotated by quaternions ([4, n], any norm but zero)."""
    wide = np.asarray(quats, np.float64)
    w, axis = wide[0], wide[1:]
    across = 2 * np.cross(axis, vectors, axis=0) / (wide * wide).sum(axis=0)
    result: np.ndarray = vectors + w * across + np.cross(axis, across, axis=0)
    return result


def matrices(quats: np.ndarray) -> np.ndarray:
    """[n, 3, 3] f64, rotation matrices of quaternions ([4, n], any norm but zero)."""
    columns = [turned(quats, np.broadcast_to(axis[:, None], (3, quats.shape[1]))) for axis in np.eye(3)]
    found: np.ndarray = np.stack(columns, axis=-1).transpose(1, 0, 2)
    return found


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
    found: np.ndarray = quats / np.sqrt((quats * quats).sum(axis=0))
    return found


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
    return _times_conjugate(unit, np.stack([np.sqrt(1 - (errors * errors).sum(axis=0)), *-errors]))


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
    nearest: np.ndarray = weights * sign
    return nearest


def _times_conjugate(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Product of quaternions `a` and the conjugate of `b`, [4, n] each."""
    w, x, y, z = a
    bw, bx, by, bz = b[0], -b[1], -b[2], -b[3]
    return np.stack(
        [
            (w * bw - x * bx) - (y * by + z * bz),
            (w * bx + x * bw) + (y * bz - z * by),
            (w * by - x * bz) + (y * bw + z * bx),
            (w * bz + x * by) - (y * bx - z * bw),
        ]
    )


def _axes(quats: np.ndarray) -> np.ndarray:
    """[3, n], the old axis behind each new axis, for conjugates of rotations of the cube."""
    w, x, y, z = quats[0], -quats[1], -quats[2], -quats[3]
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.argmax(np.abs(np.stack(column)), axis=0) for column in columns])


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
