"""Features of rows and their weighted sums, from which a channel is predicted.

All features, weights and sums are integers. We add them up in float32 if a bound shows that it holds the sum exactly,
else in float64. Both give the same numbers; float32 takes half the time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

EXACT = float(1 << 23)  # Sums below this bound are exact in float32, also with halves of 2^16 added
_PRODUCT = 1 << 17
"""Products of one matrix product. From twice as many, OpenBLAS starts threads, which cost more than they save."""


class Features:
    """Features of all rows, and a bound on each feature.

    `width`, `count`: number of features and of rows. `values`: [width, count] f32, integers in 1/256. `largest`:
    [width] f64, the largest magnitude of each feature.
    """

    def __init__(self, width: int, count: int) -> None:
        self.values = np.zeros((width, count), np.float32)
        self.largest = np.zeros(width)

    def seal(self, first: int = 0, stop: int | None = None) -> Features:
        """Update `largest` after features [first, stop) were written."""
        part = self.values[first:stop]
        if part.shape[1]:
            self.largest[first:stop] = np.maximum(part.max(axis=1), -part.min(axis=1))
        return self


@dataclass(frozen=True, eq=False)
class Term:
    """Features [first, first + len(places)) of a matrix, and the places of their weights in a group."""

    places: Sequence[int]
    features: Features
    first: int = 0

    @property
    def values(self) -> np.ndarray:
        """[features, n] f32, the values of these features."""
        return self.features.values[self.first : self.first + len(self.places)]

    @property
    def largest(self) -> np.ndarray:
        """[features] f64, the largest magnitudes of these features."""
        return self.features.largest[self.first : self.first + len(self.places)]


@dataclass(frozen=True, eq=False)
class Sums:
    """Two weighted sums for each row ([2, n], f32 or f64), and a bound on their magnitudes."""

    values: np.ndarray
    bound: float


def constant(values: np.ndarray, count: int) -> Sums:
    """Sums that have the same two numbers in every row."""
    bound = float(np.abs(values).max())
    sums = np.empty((2, count), _kind(bound))
    sums[:] = values[:, None]
    return Sums(sums, bound)


def add_terms(before: Sums, weights: np.ndarray, terms: Sequence[Term]) -> Sums:
    """Add features with their weights ([2, f] f64) to sums, in new arrays."""
    bound = before.bound + sum(float((np.abs(weights[:, t.places]) @ t.largest).max()) for t in terms)
    sums = before.values.astype(_kind(bound))
    for term in terms:
        part = weights[:, term.places].astype(sums.dtype)
        if not part.any():
            continue
        block = max(_PRODUCT // (2 * len(term.places)), 1)
        for start in range(0, sums.shape[1], block):
            rows = slice(start, start + block)
            values = term.values[:, rows].astype(sums.dtype, copy=False)
            np.add(sums[:, rows], part * values if len(term.places) == 1 else part @ values, out=sums[:, rows])
    return Sums(sums, bound)


def add_own(sums: Sums, rows: slice, weights: np.ndarray, own: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Add the features of the rows' own neighbours ([2, 2] weights); returns both sums of `rows`, [m] each."""
    bound = sums.bound
    for weight, feature in zip(weights.T, own, strict=False):
        bound += float(np.abs(weight).max() * max(feature.max(), -feature.min()))
    kind = _kind(bound)
    result = []
    for row, pair in zip(sums.values[:, rows], weights, strict=True):
        total = row.astype(kind)
        for weight, feature in zip(pair, own, strict=False):
            total += np.multiply(feature, weight, dtype=kind)
        result.append(total)
    return result


def _kind(bound: float) -> type[np.float32] | type[np.float64]:
    return np.float32 if bound < EXACT else np.float64
