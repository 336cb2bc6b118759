"""Groups of channels: each group shares one prediction, one alphabet and one set of tables, all stored in the file."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.codec.v2.features import Sums, Term, add_own, add_terms, constant
from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.codec.v2.tables import CONTEXTS_MOST, SYMBOLS_MOST

_HEAD = struct.Struct("<iBiHBBB")


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
        """Add the features that are known for all `count` rows to the prediction.

        `before` holds what was added so far.
        """
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
