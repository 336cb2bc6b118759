"""Fit groups to samples of their features and codes.

All features are integers. Sums of them are exact in double precision, so that the order in which they add up does not matter,
and parts of the samples may lie in files.
"""

from collections.abc import Iterator, Sequence

import numpy as np

from flexgs_edge.codec.v2.groups import Group, GroupKind
from flexgs_edge.memory.rows import blocks, read_rows

MEAN_BUCKETS = 12
SPREAD_BUCKETS = 5
"""Contexts of a group of values: 12 of the predicted value times 5 of the predicted error. More contexts gain less than
their tables cost: docs/results/tuning.md#codec"""
RESIDUAL_BUCKETS = 12
"""Contexts of a group of residuals: 12 of the predicted error times 2, the side that the prediction is rounded to."""
ALL_BUCKETS = 1 << 15  # A group of fewer values has fewer contexts, by the cube root: docs/results/tuning.md#levels
SYMBOL_ROOM = 192
"""Most symbols of a fitted alphabet. For more values, the low bits are coded raw, and the alphabet stays short."""
_RARE = 2000  # One in so many values may lie outside the alphabet at either end; such an escape costs 32 more bits
_RARE_FEW = 8
"""If values are few, up to 8 of them, but at most one in 50, may lie outside: one outlier must not widen the
alphabet."""
_FAR = 4
"""The fit leaves out samples with a number so many times beyond the usual ones: one of them would outweigh the rest."""

Sample = tuple[np.ndarray, np.ndarray]  # Features ([f, m] f32, integers in 1/256) and codes ([m] integers)


def fit_group(kind: GroupKind, samples: Sequence[Sample]) -> Group:
    """Fit a group to samples: weights by least squares, thresholds at quantiles, and the alphabet."""
    empty = np.zeros(0, np.int32)
    codes = np.concatenate([code for _, code in samples]) if samples else np.zeros(0, np.int64)
    if codes.size == 0 or codes.min() == codes.max():
        value = int(codes[0]) if codes.size else 0
        return Group(
            kind, value, 0 if kind.residual else value, 0, 2, np.zeros((2, kind.features + 1), np.int16), (empty, empty)
        )
    centre = int(np.sort(codes)[len(codes) // 2])
    target = (codes - centre) * 256.0
    usual = _usual(target)
    for place in range(kind.features):
        usual &= _usual(_feature(samples, place))
    solver = _LeastSquares(samples, kind.features, usual)
    mean = solver.solve(target)
    guess = _predicted(samples, mean)
    error = solver.solve(np.abs(np.rint(target - guess / 256)))
    size = _predicted(samples, error)
    few = min(float(np.cbrt(len(codes) / ALL_BUCKETS)), 1.0)
    means, spreads = (1, RESIDUAL_BUCKETS) if kind.residual else (MEAN_BUCKETS, SPREAD_BUCKETS)
    cuts = (
        _quantiles(np.floor(guess / 4096), max(round(few * means), 1)),
        _quantiles(np.floor(size / 1024), max(round(few * spreads), 1)),
    )
    symbols = codes - (np.floor(guess / 65536 + 0.5).astype(np.int64) + centre if kind.residual else 0)
    low, shift, count = _alphabet(symbols)
    return Group(kind, centre, low, shift, count, np.stack([mean, error]), cuts)


def _feature(samples: Sequence[Sample], place: int) -> np.ndarray:
    """[m] f64, one feature of all samples."""
    return np.concatenate(
        [read_rows(features[place], slice(0, features.shape[1])) for features, _ in samples], dtype=np.float64
    )


def _blocks(samples: Sequence[Sample]) -> Iterator[tuple[slice, np.ndarray]]:
    """Yield parts of the samples: places among all of them, and their features with the constant ([f + 1, b] f64)."""
    at = 0
    for features, codes in samples:
        for part in blocks(len(codes)):
            block = np.empty((features.shape[0] + 1, part.stop - part.start))
            block[:-1], block[-1] = read_rows(features, part), 256
            yield slice(at + part.start, at + part.stop), block
        at += len(codes)


def _predicted(samples: Sequence[Sample], weights: np.ndarray) -> np.ndarray:
    """[m] f64, the weighted sums of all samples."""
    return np.concatenate([weights.astype(np.float64) @ block for _, block in _blocks(samples)])


def _rare(count: int) -> int:
    """Number of outliers among `count` values that each end of the alphabet leaves out."""
    return max(count // _RARE, min(_RARE_FEW, count // 50))


def _usual(values: np.ndarray) -> np.ndarray:
    """[m] bool, False for outliers."""
    sizes = np.abs(values)
    last = len(sizes) - 1 - _rare(len(sizes))
    return sizes <= _FAR * np.partition(sizes, last)[last] + _FAR * 256


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
    return np.clip(cuts, -(2**31), 2**31 - 1).astype(np.int32)


class _LeastSquares:
    """Least-squares weights ([f + 1] i16 in 1/256) for target ~ weights . features, all in 1/256, over the `usual` samples.

    Features are scaled to 13 bits. Their products then add up exactly, so that every machine finds the same weights.
    """

    def __init__(self, samples: Sequence[Sample], features: int, usual: np.ndarray) -> None:
        self.samples, self.usual = samples, usual
        self.scales = np.array([_scale(_feature(samples, place)[usual]) for place in range(features)] + [1.0])
        self.normal = np.zeros((features + 1, features + 1))
        for _, small in self._small():
            self.normal += small @ small.T
        # A small multiple of the identity keeps the weights of constant and repeated features small.
        self.normal[np.diag_indices_from(self.normal)] += np.count_nonzero(usual)

    def _small(self) -> Iterator[tuple[slice, np.ndarray]]:
        for part, block in _blocks(self.samples):
            yield part, np.rint(block[:, self.usual[part]] * self.scales[:, None])

    def solve(self, target: np.ndarray) -> np.ndarray:
        scale, right = _scale(target[self.usual]), np.zeros(len(self.scales))
        for part, small in self._small():
            right += small @ np.rint(target[part][self.usual[part]] * scale)
        weights = _solve(self.normal, right) * self.scales / scale
        return np.clip(np.rint(weights * 256), -32767, 32767).astype(np.int16)


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
