"""Predict a row from rows decoded before: its neighbours on the Morton curve, and its own earlier channels.

Rows are coded in dyadic passes: first the multiples of 2^top, then the odd multiples of 2^(top-1), and so on. Each row
of a pass thus has decoded rows on both sides, and each pass is one vector operation. All numbers are integers that
float32 (features of one row) or float64 (weighted sums) hold exactly, so that all decoders agree to the bit. Neighbour
weights are computed by single float32 operations in a fixed order.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v2.features import Features
from flexgs_edge.constants import COARSE_ROWS, VALUE_LIMIT

REACH = (4, 2)
"""Neighbours on each side: for base channels, then for SH. SH have many channels, so they take fewer neighbours, which
saves time and costs few bits: docs/results/tuning.md#codec"""
ONE = 256
"""Features are integers in units of 1/256 of a code."""


@dataclass(frozen=True, eq=False)
class Pass:
    """Rows of one pass, and their neighbours."""

    rows: slice  # the rows, with a step
    known: slice  # the rows decoded before
    # [2 * reach, m] f32 weights of the neighbours, with a sum of about 256; None for the first pass.
    weights: np.ndarray | None
    stride: int = 1  # `rows` holds one in so many rows of the pass; 1 for all


@dataclass(frozen=True, eq=False)
class Plan:
    """All passes, and a feature of each row: 256 * bits of the squared distance to the nearest neighbour (0 in the first)."""

    passes: list[Pass]
    near: Features


def plan_passes(position: np.ndarray, reach: int, stride: int = 1) -> Plan:
    """Plan the passes over the rows of a chunk.

    `position`: [3, n], integer cells. `reach`: neighbours on each side. `stride`: take a sample of one in so many rows
    of each pass; 1 by default, for all rows.
    """
    count = position.shape[1]
    near = Features(1, count)
    if count == 0:
        return Plan([], near)
    top = max((count - 1) // COARSE_ROWS, 0).bit_length()
    points = np.ascontiguousarray(position, np.float32)
    passes = [Pass(slice(0, count, stride << top), slice(0, 0), None, stride)]
    for k in range(top - 1, -1, -1):
        rows, known = slice(1 << k, count, (2 << k) * stride), slice(0, count, 2 << k)
        here = points[:, rows]
        squares = np.zeros((2 * reach, here.shape[1]), np.float32)
        for axis in range(3):
            away = _neighbours(points[axis, known], here.shape[1], reach, stride) - here[axis]
            away *= away
            squares += away
        bits = np.frexp(squares.min(axis=0) + np.float32(1))[1]
        near.values[0, rows] = bits * np.float32(ONE)
        squares += np.float32(1)
        np.divide(np.float32(1), squares, out=squares)
        total = squares[0].copy()
        for square in squares[1:]:
            total += square
        squares *= np.float32(ONE) / total
        passes.append(Pass(rows, known, np.rint(squares, out=squares), stride))
    near.seal()
    return Plan(passes, near)


def _neighbours(known: np.ndarray, count: int, reach: int, stride: int) -> np.ndarray:
    """[2 * reach, count], the neighbours of `count` rows: row j lies between `known` j and j + 1.

    The ends are repeated.
    """
    padded = np.concatenate([np.repeat(known[:1], reach - 1), known, np.repeat(known[-1:], reach)])
    # Overlapping views of one array; as_strided does the same, but slowly.
    step = padded.itemsize
    return np.ndarray((2 * reach, count), padded.dtype, padded, 0, (step, stride * step))


def neighbour_features(values: np.ndarray, step: Pass) -> tuple[np.ndarray, ...]:
    """Weighted mean and spread of the neighbours in a pass, each [m] f32 in 1/256; an empty tuple in the first pass.

    `values`: [n] f32 values of the channel; those at `step.known` are decoded. `step`: the pass.
    """
    if step.weights is None:
        return ()
    reach, count = len(step.weights) // 2, step.weights.shape[1]
    there = _neighbours(values[step.known], count, reach, step.stride)
    # All products and sums are integers that float32 holds, so their order does not matter.
    parts = step.weights * there
    mean = np.add.reduce(parts, axis=0)
    middle = mean * np.float32(1 / ONE)
    middle += np.float32(0.5)
    np.floor(middle, middle)
    np.subtract(there, middle, parts)
    np.abs(parts, parts)
    parts *= step.weights
    return mean, np.add.reduce(parts, axis=0)


def limited(values: np.ndarray) -> np.ndarray:
    """Clip values [n] to the range that predictions use, as f32."""
    kept: np.ndarray = values.astype(np.float32)
    return np.clip(kept, np.float32(-VALUE_LIMIT), np.float32(VALUE_LIMIT), out=kept)
