"""Groups of channels: each group shares one prediction, one alphabet and one set of tables, all stored in the file.

A channel is predicted from weighted sums of features. All features, weights and sums are integers. We add them up in float32
if a bound shows that it holds the sum exactly, else in float64. Both give the same numbers; float32 takes half the time.
"""

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.codec.v2.tables import CONTEXTS_MOST, SYMBOLS_MOST

_HEAD = struct.Struct("<iBiHBBB")
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

    def seal(self, first: int = 0, stop: int | None = None) -> "Features":
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


@dataclass(frozen=True)
class GroupKind:
    """The properties of a group that the format fixes."""

    name: str  # for reports and error messages
    features: int  # number of features of its prediction
    residual: bool  # symbols are differences from the prediction; if False, they are the values
    sh: bool  # a scene without SH does not have this group


@dataclass(frozen=True, eq=False)
class Group:
    """A group with its fitted numbers."""

    kind: GroupKind
    centre: int  # added to every prediction
    low: int  # code of symbol 0
    shift: int  # number of low bits that are coded raw
    symbols: int  # Size of the alphabet. The last symbol is the escape, unless nothing was escaped.
    # [2, features + 1] i16, in 1/256: weights of the value, then of the size of the error; the constant comes last.
    weights: np.ndarray
    # Two lists of thresholds, [<= 15] i32 each, ascending: of the predicted value in 1/16, and of the predicted error
    # in 1/64. The first list is empty for residuals: the side of the rounding takes its place.
    cuts: tuple[np.ndarray, np.ndarray]

    @property
    def contexts(self) -> int:
        """Number of contexts of a symbol."""
        means = 2 if self.kind.residual else len(self.cuts[0]) + 1
        return means * (len(self.cuts[1]) + 1)

    @property
    def start(self) -> int:
        """Number added to every symbol: the code of symbol 0, plus the centre if symbols are residuals."""
        return self.centre * self.kind.residual + self.low

    def known(self, terms: Sequence[Term], count: int, before: Sums | None = None) -> Sums:
        """Add the features that are known for all `count` rows to the prediction. `before` holds what was added so far."""
        weights = self.weights.astype(np.float64)
        return add_terms(constant(256 * weights[:, -1], count) if before is None else before, weights, terms)

    def predict(self, known: Sums, rows: slice, own: Sequence[np.ndarray]) -> tuple[np.ndarray | float, np.ndarray]:
        """Predict the codes of some rows.

        `known`: from `known`, for all rows. `rows`: the rows to predict. `own`: mean and spread of the rows'
        neighbours, [m] f32 each; empty in the first pass. Returns the base to subtract from the codes ([m] f32 or f64,
        or one number), and the contexts ([m] u8).
        """
        mean, error = add_own(known, rows, self.weights[:, :2].astype(np.float64), own)
        # If float32 rounds a threshold, the threshold lies beyond every sum that float32 holds.
        spread = _bucket(error, [1024.0 * cut for cut in self.cuts[1].tolist()])
        levels = np.uint8(len(self.cuts[1]) + 1)
        start = float(self.start)
        if not self.kind.residual:
            place = _bucket(mean, [4096.0 * cut for cut in self.cuts[0].tolist()])
            place *= levels
            place += spread
            return start, place
        whole = mean * mean.dtype.type(1 / 65536)
        whole += mean.dtype.type(0.5)
        np.floor(whole, whole)
        side = (mean >= whole * mean.dtype.type(65536)).view(np.uint8)
        side *= levels
        side += spread
        return whole.astype(np.float64) + start, side

    def to_bytes(self) -> bytes:
        """The group's record in the file."""
        head = _HEAD.pack(
            self.centre, self.shift, self.low, self.symbols, *(len(cut) for cut in self.cuts), bool(self.weights.any())
        )
        weights = self.weights.astype("<i2").tobytes() if self.weights.any() else b""
        return head + weights + b"".join(cut.astype("<i4").tobytes() for cut in self.cuts)

    @classmethod
    def read(cls, kind: GroupKind, data: bytes, at: int) -> "tuple[Group, int]":
        """Read a group's record at byte `at`; returns the group and the byte after the record."""
        if len(data) < at + _HEAD.size:
            raise StreamError(f"group {kind.name}: wanted {_HEAD.size} bytes, got {len(data) - at}")
        centre, shift, low, symbols, *lengths, weighted = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        size = 4 * (kind.features + 1) if weighted else 0
        end = at + size + 4 * sum(lengths)
        if weighted > 1 or shift > 24 or not 1 <= symbols <= SYMBOLS_MOST or max(lengths) > 15 or end > len(data):
            raise StreamError(
                f"group {kind.name}: wanted a record within its limits, got {data[at - _HEAD.size : at]!r}"
            )
        weights = np.zeros((2, kind.features + 1), np.int16)
        if weighted:
            weights[:] = np.frombuffer(data, "<i2", size // 2, at).reshape(2, -1)
        cuts = np.frombuffer(data, "<i4", sum(lengths), at + size)
        group = cls(kind, centre, low, shift, symbols, weights, (cuts[: lengths[0]], cuts[lengths[0] :]))
        if group.contexts > CONTEXTS_MOST:
            raise StreamError(f"group {kind.name}: wanted at most {CONTEXTS_MOST} contexts, got {group.contexts}")
        return group, end


def _bucket(values: np.ndarray, cuts: Sequence[float]) -> np.ndarray:
    """[m] u8, the number of cuts that are not larger than the value."""
    result, beyond = np.zeros(len(values), np.uint8), np.empty(len(values), bool)
    for cut in cuts:
        np.greater_equal(values, values.dtype.type(cut), beyond)
        result += beyond.view(np.uint8)
    return result
