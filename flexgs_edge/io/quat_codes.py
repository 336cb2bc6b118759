"""Quaternions in three bytes: of several ways to round one, that which moves the Gaussian least.

A Gaussian has 24 equal forms: its axes in another order or reversed, and its quaternion turned to match. Six of them round
differently. Errors of rotation count by what they do to the shape: a turn of a disc about its own axis costs nothing.
"""

from __future__ import annotations

from itertools import product

import numpy as np

SMALLER = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""The components of a quaternion that are stored, by the largest one."""
_HALF = float(np.sqrt(0.5))
_FORMS: tuple[tuple[tuple[float, float, float, float], tuple[int, int, int]], ...] = (
    ((1.0, 0.0, 0.0, 0.0), (0, 1, 2)),
    ((_HALF, _HALF, 0.0, 0.0), (0, 2, 1)),
    ((_HALF, 0.0, _HALF, 0.0), (2, 1, 0)),
    ((_HALF, 0.0, 0.0, _HALF), (1, 0, 2)),
    ((0.5, 0.5, 0.5, 0.5), (1, 2, 0)),
    ((0.5, -0.5, -0.5, -0.5), (2, 0, 1)),
)
"""Turns of the axes, w x y z, and the old axis behind each new one. The other 18 forms swap and negate components only."""
_ROUND = 1e-4
"""What turns of round Gaussians count, so that these round to the nearest."""


def unpack_small(codes: np.ndarray, mode: np.ndarray) -> np.ndarray:
    """[n, 4] f64, unit quaternions w x y z of their three smaller components ([n, 3] u8) and the place of the largest."""
    small = (codes / 255 * 2 - 1) * _HALF
    square = small * small
    quats = np.empty((len(small), 4))
    np.put_along_axis(quats, SMALLER[mode], small, axis=1)
    largest = np.sqrt(np.maximum(0, 1 - ((square[:, 0] + square[:, 1]) + square[:, 2])))
    np.put_along_axis(quats, mode[:, None], largest[:, None], axis=1)
    return quats


def rounded_quats(quats: np.ndarray, log_scales: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Choose the form and the rounding of each quaternion.

    `quats`: [n, 4] f64, unit quaternions w x y z; `log_scales`: [n, 3].

    Returns the codes of the three smaller components, [n, 3] u8; the place of the largest, [n]; and the old axis behind
    each axis of the form, [n, 3].
    """
    # float32: the last bits of exp differ between machines, and must not decide.
    scales = np.exp(log_scales - log_scales.max(axis=1, keepdims=True)).astype(np.float32).astype(np.float64)
    best = np.full(len(quats), np.inf)
    codes, mode, axes = np.zeros((len(quats), 3)), np.zeros(len(quats), np.int64), np.zeros((len(quats), 3), np.int64)
    for turn, order in _FORMS:
        form = _product(quats, np.array(turn))
        place = np.abs(form).argmax(axis=1)
        form *= np.where(np.take_along_axis(form, place[:, None], axis=1) < 0, -1.0, 1.0)
        exact = (np.take_along_axis(form, SMALLER[place], axis=1) * _HALF + 0.5) * 255
        weight = _turn_weights(scales[:, order])
        for up in product((0, 1), repeat=3):
            near = np.clip(np.floor(exact) + up, 0, 255)
            error = _product(form * (1, -1, -1, -1), unpack_small(near, place))[:, 1:]
            loss = error * error * weight
            total = (loss[:, 0] + loss[:, 1]) + loss[:, 2]
            better = np.flatnonzero(total < best)
            best[better], codes[better], mode[better], axes[better] = total[better], near[better], place[better], order
    return codes.astype(np.uint8), mode, axes


def _turn_weights(scales: np.ndarray) -> np.ndarray:
    """[n, 3], what the squares of small turns about each axis do to a Gaussian, as the squared Wasserstein distance."""
    square = scales * scales
    first, second = square[:, [1, 2, 0]], square[:, [2, 0, 1]]
    return np.asarray((first - second) ** 2 / np.maximum(first + second, 1e-30) + _ROUND)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n, 4], products of quaternions w x y z."""
    (w, x, y, z), (bw, bx, by, bz) = np.moveaxis(a, -1, 0), np.moveaxis(b, -1, 0)
    return np.stack(
        [
            (w * bw - x * bx) - (y * by + z * bz),
            (w * bx + x * bw) + (y * bz - z * by),
            (w * by - x * bz) + (y * bw + z * bx),
            (w * bz + x * by) - (y * bx - z * bw),
        ],
        axis=-1,
    )
