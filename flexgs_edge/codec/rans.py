"""Range asymmetric numeral systems (rANS; Duda 2013) over many lanes at once, with static tables in integers.

32-bit states at or above 2^16, 16-bit words, probabilities in 1/2^14. Every batch of symbols starts at lane 0 and goes
round the lanes; one vector operation moves all lanes by one symbol, so NumPy pays its overhead once for a round.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

PRECISION = 14
TOTAL = 1 << PRECISION
"""Frequencies of a table add up to this."""
FLOOR = 1 << 16
"""Smallest state between symbols, and the first state of every lane."""
LANES_MOST = 512


def lane_count(rows: int) -> int:
    """Lanes of a stream for `rows` rows: a power of two, one for at least 128 rows (4 bytes each, below 0.5 %).

    >>> [lane_count(rows) for rows in (0, 127, 256, 65536, 10**6)]
    [1, 1, 2, 512, 512]
    """
    return min(1 << max((rows // 128).bit_length() - 1, 0), LANES_MOST)


class StreamError(ValueError):
    """A stream that no encoder wrote."""


class Tables:
    """Frequency tables of one alphabet.

    Parameters
    ----------
    freqs : np.ndarray
        [t, a] integers; every row adds up to 2^14. At most 2^16 symbols.
    """

    def __init__(self, freqs: np.ndarray) -> None:
        self.freqs = np.ascontiguousarray(freqs, np.uint32)
        if self.freqs.ndim != 2 or not np.all(self.freqs.sum(axis=1, dtype=np.int64) == TOTAL):
            raise StreamError(f"frequencies: wanted rows that add up to {TOTAL}")
        self.size = self.freqs.shape[1]
        starts = np.zeros_like(self.freqs)
        np.cumsum(self.freqs[:, :-1], axis=1, out=starts[:, 1:])
        self.flat_freqs = self.freqs.reshape(-1)
        self.flat_starts = starts.reshape(-1)
        self._slots: np.ndarray | None = None

    @property
    def slots(self) -> np.ndarray:
        """[t * 2^14]: the symbol of every slot of every table."""
        if self._slots is None:
            kind = np.uint8 if self.size <= 256 else np.uint16
            symbols = np.tile(np.arange(self.size, dtype=kind), len(self.freqs))
            self._slots = np.repeat(symbols, self.flat_freqs)
        return self._slots

    def bits(self, tables: np.ndarray, symbols: np.ndarray) -> float:
        """Information of symbols in bits (floating point, for reports only)."""
        return float((PRECISION - np.log2(self.flat_freqs[tables.astype(np.int64) * self.size + symbols])).sum())


class Encoder:
    """Collects batches in the order in which they will be decoded, and writes them backwards.

    Parameters
    ----------
    lanes : int
        From `lane_count`.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self._batches: list[tuple[np.ndarray, np.ndarray]] = []

    def put(self, tables: Tables, rows: np.ndarray, symbols: np.ndarray) -> None:
        """Add a batch: `symbols` [m], each coded by row `rows` [m] of `tables`. Zero frequencies are the caller's bug."""
        place = rows.astype(np.int64) * tables.size + symbols
        freqs = tables.flat_freqs[place]
        if not freqs.all():
            raise AssertionError("a symbol without a frequency")
        self._batches.append((freqs, tables.flat_starts[place].astype(np.uint32)))

    def finish(self) -> bytes:
        """The stream: the states of all lanes as u32, then words as u16."""
        states = np.full(self.lanes, FLOOR, np.uint64)
        words = []
        shift = np.uint64(PRECISION)
        for freqs, starts in reversed(self._batches):
            wide, begin = freqs.astype(np.uint64), starts.astype(np.uint64)
            limit = wide << np.uint64(32 - PRECISION)
            for at in range((len(freqs) - 1) // self.lanes * self.lanes, -1, -self.lanes):
                part = slice(at, at + self.lanes)
                state, freq = states[: len(wide[part])], wide[part]
                full = state >= limit[part]
                words.append(state[full].astype("<u2"))  # the low 16 bits
                state >>= full.astype(np.uint64) << np.uint64(4)
                quotient = state // freq
                state += quotient * ((np.uint64(1) << shift) - freq)
                state += begin[part]
        words.append(states.astype("<u4").view("<u2"))
        return np.concatenate(words[::-1]).tobytes()


class Decoder:
    """Reads what `Encoder` wrote, batch by batch.

    Parameters
    ----------
    data : bytes
        The stream, and padding that may follow it.
    lanes : int
        As in the encoder.
    """

    def __init__(self, data: bytes, lanes: int) -> None:
        if len(data) < 4 * lanes or len(data) % 2:
            raise StreamError(f"stream: wanted an even number of at least {4 * lanes} bytes, got {len(data)}")
        words = np.frombuffer(data, "<u2")
        self.lanes = lanes
        self._states = words[: 2 * lanes].view("<u4").astype(np.uint32)
        self._words = words
        self._at = 2 * lanes
        if (self._states < FLOOR).any():
            raise StreamError("stream: wanted states of at least 65536")

    def get(self, tables: Tables, rows: np.ndarray) -> np.ndarray:
        """[m] symbols of the next batch (u8 or u16), each coded by row `rows` [m] of `tables`."""
        slots = tables.slots
        out = np.empty(len(rows), slots.dtype)
        base = rows.astype(np.int64)
        first = base << PRECISION
        base *= tables.size
        for at in range(0, len(rows), self.lanes):
            part = slice(at, min(at + self.lanes, len(rows)))
            state = self._states[: part.stop - at]
            low = state & np.uint32(TOTAL - 1)
            symbols = slots.take(first[part] + low)
            out[part] = symbols
            place = base[part] + symbols
            state >>= np.uint32(PRECISION)
            state *= tables.flat_freqs.take(place)
            low -= tables.flat_starts.take(place)
            state += low
            empty = (state < FLOOR).nonzero()[0]
            if len(empty):
                words = self._words[self._at : self._at + len(empty)]
                if len(words) < len(empty):
                    raise StreamError("stream: wanted more words, got its end")
                self._at += len(empty)
                state[empty] = (state[empty] << np.uint32(16)) | words
        return out

    def finish(self) -> int:
        """Bytes read; raises `StreamError` unless every lane is back in its first state."""
        if (self._states != FLOOR).any():
            raise StreamError("stream: wanted every lane to end in its first state")
        return 2 * self._at


def normalize(weights: Sequence[int] | np.ndarray) -> np.ndarray:
    """Frequencies that add up to 2^14 in proportion to `weights` [a]; at least 1 where a weight is not 0.

    Floor of the share, at least 1; what is missing or too much goes to the largest frequencies in turn: one unit each,
    the first of equals first. Integers only, so that every decoder finds the same.
    """
    weights = np.asarray(weights, np.int64)
    total = int(weights.sum())
    if total <= 0 or np.count_nonzero(weights) > TOTAL // 2 or weights.min() < 0 or total >= 1 << 48:
        raise StreamError("weights: wanted some above 0")
    freqs = np.maximum(weights * TOTAL // total, weights > 0)
    order = np.argsort(-freqs, kind="stable")[: np.count_nonzero(weights)]
    missing = TOTAL - int(freqs.sum())
    while missing:
        # Taking away must leave 1.
        able = order if missing > 0 else order[freqs[order] > 1]
        chosen = able[: abs(missing)]
        freqs[chosen] += 1 if missing > 0 else -1
        missing += -len(chosen) if missing > 0 else len(chosen)
    return freqs
