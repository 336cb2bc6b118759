"""What is known of a row before it is decoded: rows near it on the curve, and its own earlier channels.

Rows are coded in dyadic passes: first those at multiples of 2^top, then the odd multiples of 2^(top-1), and so on; every
row has decoded rows on both sides, and a pass is one vector operation. All numbers are integers that float32 (features
of one row) or float64 (weighted sums) hold exactly, so that decoders agree to the bit; neighbour weights take single
float32 operations in a written order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

COARSE_ROWS = 256
"""The first pass has at most this many rows; they have no neighbours yet."""
REACH = (4, 2)
"""Neighbours on each side for the base channels, and for SH: they are many, and half the reach costs 1 % of their bits."""
VALUE_LIMIT = 16383.0
"""Values count as at most this large in predictions: sums of 256 of them stay exact in float32."""
ONE = 256
"""Features count in 1/256 of a code."""


@dataclass(frozen=True, eq=False)
class Pass:
    """Some rows of one pass and where their neighbours lie.

    Parameters
    ----------
    rows : slice
        The rows, with a step.
    known : slice
        The rows decoded before.
    weights : np.ndarray or None
        [2 * reach, m] f32 weights of the neighbours, about 256 in all; None for the first pass.
    near : np.ndarray or None
        [m] f32: 256 * bits of the squared distance to the nearest neighbour.
    """

    rows: slice
    known: slice
    weights: np.ndarray | None
    near: np.ndarray | None


def plan_passes(position: np.ndarray, reach: int) -> list[Pass]:
    """The passes over rows at `position` ([3, n] integer cells)."""
    count = position.shape[1]
    if count == 0:
        return []
    top = max((count - 1) // COARSE_ROWS, 0).bit_length()
    points = np.ascontiguousarray(position, np.float32)
    passes = [Pass(slice(0, count, 1 << top), slice(0, 0), None, None)]
    for k in range(top - 1, -1, -1):
        rows, known = slice(1 << k, count, 2 << k), slice(0, count, 2 << k)
        here = points[:, rows]
        squares = np.zeros((2 * reach, here.shape[1]), np.float32)
        for axis in range(3):
            for square, there in zip(squares, _neighbours(points[axis, known], here.shape[1], reach), strict=True):
                away = there - here[axis]
                away *= away
                square += away
        near = np.frexp(squares.min(axis=0) + np.float32(1))[1].astype(np.float32) * ONE
        squares += np.float32(1)
        np.divide(np.float32(1), squares, out=squares)
        total = squares[0].copy()
        for square in squares[1:]:
            total += square
        factor = np.float32(ONE) / total
        squares *= factor
        passes.append(Pass(rows, known, np.rint(squares, out=squares), near))
    return passes


def _neighbours(known: np.ndarray, count: int, reach: int) -> list[np.ndarray]:
    """Neighbours on both sides of each of `count` rows: row j lies between `known` j and j + 1; ends are repeated."""
    padded = np.concatenate([np.repeat(known[:1], reach - 1), known, np.repeat(known[-1:], reach)])
    return [padded[i : i + count] for i in range(2 * reach)]


def neighbour_features(values: np.ndarray, step: Pass) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Weighted mean, spread and distance of the neighbours of a pass, each [m] f32 in 1/256.

    Parameters
    ----------
    values : np.ndarray
        [n] f32 values of the channel, of which those at `step.known` are decoded.
    step : Pass
        The pass.
    """
    if step.weights is None:
        count = len(values[step.rows])
        return np.zeros(count, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
    near = step.near
    assert near is not None
    there = _neighbours(values[step.known], len(near), len(step.weights) // 2)
    mean = np.zeros_like(near)
    for weight, value in zip(step.weights, there, strict=True):
        mean += weight * value
    middle = np.floor(mean * np.float32(1 / ONE) + np.float32(0.5))
    spread = np.zeros_like(near)
    for weight, value in zip(step.weights, there, strict=True):
        away = value - middle
        spread += weight * np.abs(away, out=away)
    return mean, spread, near


@dataclass(frozen=True, eq=False)
class Known:
    """A decoded channel as a source of features, each [n] f32 in 1/256: its values, and how far they are from the mean."""

    value: np.ndarray
    mean: np.ndarray

    def features(self, rows: slice) -> list[np.ndarray]:
        """Value, neighbours' mean, and distance from it."""
        value, mean = self.value[rows], self.mean[rows]
        return [value, mean, np.abs(value - mean)]


def limited(values: np.ndarray) -> np.ndarray:
    """Values [n] as f32 that predictions may use."""
    kept: np.ndarray = np.clip(values, -VALUE_LIMIT, VALUE_LIMIT).astype(np.float32)
    return kept
