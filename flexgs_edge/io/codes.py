"""Codes that several formats share: nearest integers, opacities, and quaternions without their largest component."""

from __future__ import annotations

import numpy as np


def nearest(values: np.ndarray, most: int = 255) -> np.ndarray:
    """The nearest integers from 0 to `most`: u8, or u32 where these do not suffice.

    >>> nearest(np.array([-3.0, 0.6, 300.0])).tolist()
    [0, 1, 255]
    """
    codes: np.ndarray = np.clip(np.rint(values), 0, most).astype(np.uint8 if most < 256 else np.uint32)
    return codes


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
    rest: np.ndarray = np.sqrt(np.maximum(1 - (parts * parts).sum(axis=0, keepdims=True), 0))
    return rest


def _places(largest: np.ndarray) -> np.ndarray:
    """[3, n], the places of the others: behind the largest, they move on by one."""
    places = np.arange(3)[:, None]
    moved: np.ndarray = places + (places >= largest)
    return moved
