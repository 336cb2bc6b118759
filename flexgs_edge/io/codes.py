"""Codes that several formats share: nearest integers, opacities, and quaternions without their largest component."""

from itertools import product

import numpy as np

from flexgs_edge.small_matrices import quaternion_product

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
_ROUND = 1e-4  # What turns of round Gaussians count, so that these round to the nearest


def nearest(values: np.ndarray, most: int = 255) -> np.ndarray:
    """The nearest integers from 0 to `most`: u8, or u32 where these do not suffice.

    >>> nearest(np.array([-3.0, 0.6, 300.0])).tolist()
    [0, 1, 255]
    """
    return np.clip(np.rint(values), 0, most).astype(np.uint8 if most < 256 else np.uint32)


def opacities(logits: np.ndarray) -> np.ndarray:
    """f64, 0 to 1."""
    with np.errstate(over="ignore"):
        opaque: np.ndarray = 1 / (1 + np.exp(-logits.astype(np.float64)))
    return opaque


def without_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Leave out the largest component of unit quaternions: the others tell it.

    `quats`: [4, n], components in any order. Returns [n] i64, the place of the largest; and [3, n] f64, the others in
    their order. q and -q are one rotation: the signs are those that make the largest positive.
    """
    wide = quats.astype(np.float64)
    largest = np.abs(wide).argmax(axis=0)
    wide *= np.where(np.take_along_axis(wide, largest[None], axis=0) < 0, -1.0, 1.0)
    return largest, np.take_along_axis(wide, _places(largest), axis=0)


def with_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """[4, n] f64, unit quaternions from what `without_largest` gives; the largest is 0 where the others are too long."""
    found = np.empty((4, len(largest)))
    np.put_along_axis(found, _places(largest), others, axis=0)
    np.put_along_axis(found, largest[None], rest_of_unit(others), axis=0)
    return found


def rest_of_unit(parts: np.ndarray) -> np.ndarray:
    """[1, n], the component that makes quaternions of norm 1 of `parts` [3, n]."""
    return np.sqrt(np.maximum(1 - (parts * parts).sum(axis=0, keepdims=True), 0))


def _places(largest: np.ndarray) -> np.ndarray:
    """[3, n], the places of the others: behind the largest, they move on by one."""
    places = np.arange(3)[:, None]
    return places + (places >= largest)


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
    return quaternion_product(a.T, b.T).T
