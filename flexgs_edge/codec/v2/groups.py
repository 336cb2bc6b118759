"""Groups of channels: each group shares one fitted prediction, one alphabet and one set of tables, all stored in the file."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v2.features import Sums, Term, add_own, add_terms, constant
from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.codec.v2.tables import CONTEXTS_MOST, SYMBOLS_MOST

_HEAD = struct.Struct("<iBiHBBB")
MEAN_BUCKETS = 12
SPREAD_BUCKETS = 5
"""Contexts of a group of values: 12 of the predicted value times 5 of the predicted error. More contexts gain less than
their tables cost: docs/results/tuning.md#codec"""
RESIDUAL_BUCKETS = 12
"""Contexts of a group of residuals: 12 of the predicted error times 2, the side that the prediction is rounded to."""
ALL_BUCKETS = 1 << 15
"""A group of fewer values has fewer contexts, by the cube root: docs/results/tuning.md#levels"""
SYMBOL_ROOM = 192
"""Most symbols of a fitted alphabet. For more values, the low bits are coded raw, and the alphabet stays short."""
_RARE = 2000
"""One in so many values may lie outside the alphabet at either end; such an escape costs 32 more bits."""
_RARE_FEW = 8
"""If values are few, up to 8 of them, but at most one in 50, may lie outside: one outlier must not widen the
alphabet."""
_FAR = 4
"""The fit leaves out samples with a number so many times beyond the usual ones: one of them would outweigh the rest."""


@dataclass(frozen=True)
class GroupKind:
    """The properties of a group that the format fixes.

    Parameters
    ----------
    name : str
        For reports and error messages.
    features : int
        Number of features of its prediction.
    residual : bool
        Symbols are differences from the prediction; if False, they are the values.
    sh : bool
        A scene without SH does not have this group.
    """

    name: str
    features: int
    residual: bool
    sh: bool


@dataclass(frozen=True, eq=False)
class Group:
    """A group with its fitted numbers.

    Parameters
    ----------
    centre : int
        Added to every prediction.
    low : int
        Code of symbol 0.
    shift : int
        Number of low bits that are coded raw.
    symbols : int
        Size of the alphabet. The last symbol is the escape, unless nothing was escaped.
    weights : np.ndarray
        [2, features + 1] i16, in 1/256: weights of the value, then of the size of the error; the constant comes last.
    cuts : tuple of np.ndarray
        Two lists of thresholds, [<= 15] i32 each, ascending: of the predicted value in 1/16, and of the predicted error
        in 1/64. The first list is empty for residuals: the side of the rounding takes its place.
    """

    kind: GroupKind
    centre: int
    low: int
    shift: int
    symbols: int
    weights: np.ndarray
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
        """Add the features that are known for all `count` rows to the prediction.

        `before` holds what was added so far.
        """
        weights = self.weights.astype(np.float64)
        return add_terms(constant(256 * weights[:, -1], count) if before is None else before, weights, terms)

    def predict(self, known: Sums, rows: slice, own: Sequence[np.ndarray]) -> tuple[np.ndarray | float, np.ndarray]:
        """Predict the codes of some rows.

        Parameters
        ----------
        known : Sums
            From `known`, for all rows.
        rows : slice
            The rows to predict.
        own : sequence of np.ndarray
            Mean and spread of the rows' neighbours, [m] f32 each; empty in the first pass.

        Returns
        -------
        tuple
            The base to subtract from the codes ([m] f32 or f64, or one number), and the contexts ([m] u8).
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
    def read(cls, kind: GroupKind, data: bytes, at: int) -> tuple[Group, int]:
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


def fit_group(kind: GroupKind, batches: list[tuple[list[np.ndarray], np.ndarray]]) -> Group:
    """Fit a group to samples (features, codes): weights by least squares, thresholds at quantiles, and the alphabet."""
    empty = np.zeros(0, np.int32)
    codes = np.concatenate([code for _, code in batches]) if batches else np.zeros(0, np.int64)
    if codes.size == 0 or codes.min() == codes.max():
        value = int(codes[0]) if codes.size else 0
        return Group(
            kind, value, 0 if kind.residual else value, 0, 2, np.zeros((2, kind.features + 1), np.int16), (empty, empty)
        )
    centre = int(np.sort(codes)[len(codes) // 2])
    matrix = np.empty((kind.features + 1, len(codes)))
    matrix[-1], at = 256, 0
    for features, _ in batches:
        end = at + len(features[0])
        for row, feature in zip(matrix, features, strict=False):
            row[at:end] = feature
        at = end
    target = (codes - centre) * 256.0
    usual = _usual(target)
    for row in matrix[:-1]:
        usual &= _usual(row)
    solve = _LeastSquares(matrix[:, usual])
    mean = solve(target[usual])
    guess = mean.astype(np.float64) @ matrix
    error = solve(np.abs(np.rint(target - guess / 256))[usual])
    size = error.astype(np.float64) @ matrix
    few = min(float(np.cbrt(len(codes) / ALL_BUCKETS)), 1.0)
    means, spreads = (1, RESIDUAL_BUCKETS) if kind.residual else (MEAN_BUCKETS, SPREAD_BUCKETS)
    cuts = (
        _quantiles(np.floor(guess / 4096), max(round(few * means), 1)),
        _quantiles(np.floor(size / 1024), max(round(few * spreads), 1)),
    )
    symbols = codes - (np.floor(guess / 65536 + 0.5).astype(np.int64) + centre if kind.residual else 0)
    low, shift, count = _alphabet(symbols)
    return Group(kind, centre, low, shift, count, np.stack([mean, error]), cuts)


def _rare(count: int) -> int:
    """Number of outliers among `count` values that each end of the alphabet leaves out."""
    return max(count // _RARE, min(_RARE_FEW, count // 50))


def _usual(values: np.ndarray) -> np.ndarray:
    """[m] bool, False for outliers."""
    sizes = np.abs(values)
    last = len(sizes) - 1 - _rare(len(sizes))
    usual: np.ndarray = sizes <= _FAR * np.partition(sizes, last)[last] + _FAR * 256
    return usual


def _alphabet(symbols: np.ndarray) -> tuple[int, int, int]:
    """Lowest code, number of raw low bits, and size of the alphabet, with room for an escape at its end."""
    ordered = np.sort(symbols)
    rare = _rare(len(ordered))
    low, high = int(ordered[rare]), int(ordered[-1 - rare])
    span = high - low + 1
    # A short range is kept whole: a symbol costs less than an escape.
    if int(ordered[-1]) - int(ordered[0]) < SYMBOL_ROOM:
        low, span = int(ordered[0]), int(ordered[-1]) - int(ordered[0]) + 1
    shift = max((span - 1) // SYMBOL_ROOM, 0).bit_length()
    return low, shift, ((span + (1 << shift) - 1) >> shift) + 1


def _quantiles(values: np.ndarray, count: int) -> np.ndarray:
    ordered = np.sort(values)
    cuts = ordered[len(ordered) * np.arange(1, count) // count]
    cuts = np.unique(cuts[cuts > ordered[0]])
    kept: np.ndarray = np.clip(cuts, -(2**31), 2**31 - 1).astype(np.int32)
    return kept


class _LeastSquares:
    """Least-squares weights ([f] i16 in 1/256) for target ~ weights . features, all in 1/256.

    Features [f, m] are scaled to 13 bits. Their products then add up exactly, so that every machine finds the same
    weights.
    """

    def __init__(self, features: np.ndarray) -> None:
        self.scales = np.array([_scale(row) for row in features])
        self.small = np.rint(features * self.scales[:, None])
        self.normal = self.small @ self.small.T
        # A small multiple of the identity keeps the weights of constant and repeated features small.
        self.normal[np.diag_indices_from(self.normal)] += features.shape[1]

    def __call__(self, target: np.ndarray) -> np.ndarray:
        scale = _scale(target)
        weights = _solve(self.normal, self.small @ np.rint(target * scale)) * self.scales / scale
        rounded: np.ndarray = np.clip(np.rint(weights * 256), -32767, 32767).astype(np.int16)
        return rounded


def _scale(values: np.ndarray) -> float:
    """The power of two that scales values to 13 bits."""
    largest: int = int(np.abs(values).max())
    return float(2.0 ** -max(largest.bit_length() - 13, 0))


def _solve(normal: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve a positive definite system by elimination in a fixed order; the order of a library may differ."""
    rows = np.append(normal, right[:, None], axis=1)
    size = len(right)
    for i in range(size):
        rows[i] /= rows[i, i]
        for j in range(size):
            if j != i:
                rows[j] -= rows[i] * rows[j, i]
    return rows[:, -1]
