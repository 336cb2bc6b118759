"""Range asymmetric numeral systems (rANS; Duda 2013) over many lanes at once, with static tables in integers.

32-bit states at or above 2^16, 16-bit words, probabilities in 1/2^14. Every batch of symbols starts at lane 0 and goes
round the lanes; one vector operation moves all lanes by one symbol, so NumPy pays its overhead once for a round.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

import numpy as np

from flexgs_edge.constants import RANS_FLOOR as FLOOR
from flexgs_edge.constants import RANS_LANES as LANES_MOST
from flexgs_edge.constants import RANS_PRECISION as PRECISION
from flexgs_edge.constants import RANS_TOTAL as TOTAL

_LOW, _SHIFT, _WORD = np.uint32(TOTAL - 1), np.uint32(PRECISION), np.uint32(16)
_FLOOR = np.uint32(FLOOR)


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
        self.entries = ((self.freqs << _SHIFT) | starts).reshape(-1)
        """[t * a] u32: frequency and start of every symbol, 0 where the frequency is."""
        self._slots: np.ndarray | None = None
        self._moves: np.ndarray | None = None

    @property
    def slots(self) -> np.ndarray:
        """[t * 2^14]: the symbol of every slot of every table."""
        if self._slots is None:
            kind = np.uint8 if self.size <= 256 else np.uint16
            symbols = np.tile(np.arange(self.size, dtype=kind), len(self.freqs))
            self._slots = np.repeat(symbols, self.freqs.reshape(-1))
        return self._slots

    @property
    def moves(self) -> np.ndarray:
        """[t * 2^14] u32: frequency, and place in its symbol, of every slot: one look-up a step of the decoder."""
        if self._moves is None:
            freqs = self.freqs.reshape(-1)
            moves = np.repeat((freqs << _SHIFT) - (self.entries & _LOW), freqs)
            moves.reshape(-1, TOTAL)[:] += np.arange(TOTAL, dtype=np.uint32)
            self._moves = moves
        return self._moves

    def bits(self, tables: np.ndarray, symbols: np.ndarray) -> float:
        """Information of symbols in bits (floating point, for reports only)."""
        return float((PRECISION - np.log2(self.freqs[tables, symbols])).sum())


class Encoder:
    """Collects batches in the order in which they will be decoded, and writes them backwards.

    Parameters
    ----------
    lanes : int
        From `lane_count`.
    """

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self._batches: list[np.ndarray] = []

    def put(self, tables: Tables, rows: np.ndarray, symbols: np.ndarray) -> None:
        """Add a batch: `symbols` [m], each coded by row `rows` [m] of `tables`. Zero frequencies are the caller's bug."""
        place = rows.astype(np.intp)
        place *= tables.size
        place += symbols
        entries = tables.entries.take(place)
        if not entries.all():
            raise AssertionError("a symbol without a frequency")
        self._batches.append(entries)

    @property
    def batches(self) -> list[np.ndarray]:
        """Frequency and start of every symbol of the batches so far ([m] u32 each)."""
        return self._batches

    def finish(self) -> bytes:
        """The stream: the states of all lanes as u32, then words as u16."""
        # Doubles hold states exactly, and their division is a vector instruction: a state and a frequency differ too
        # much from 2^53 for a quotient to be rounded up to the next integer.
        states = np.full(self.lanes, float(FLOOR))
        quotient, full = np.empty(self.lanes), np.empty(self.lanes, bool)
        words = []
        for entries in reversed(self._batches):
            freqs = (entries >> _SHIFT).astype(np.float64)
            starts = (entries & _LOW).astype(np.float64)
            limits, others = freqs * float(1 << 32 - PRECISION), TOTAL - freqs
            for at in range((len(freqs) - 1) // self.lanes * self.lanes, -1, -self.lanes):
                part = slice(at, at + self.lanes)
                freq = freqs[part]
                size = len(freq)
                state, count, over = states[:size], quotient[:size], full[:size]
                np.greater_equal(state, limits[part], over)
                places = over.nonzero()[0]
                if len(places):
                    large = state.take(places).astype(np.uint32)
                    words.append(large.astype("<u2"))  # the low 16 bits
                    large >>= _WORD
                    state[places] = large
                np.divide(state, freq, count)
                np.floor(count, count)
                np.multiply(count, others[part], count)
                np.add(state, count, state)
                np.add(state, starts[part], state)
        words.append(states.astype("<u4").view("<u2"))
        return np.concatenate(words[::-1]).tobytes()


def first_states(data: bytes, lanes: int) -> np.ndarray:
    """[lanes] u32 states at the head of a stream, checked."""
    if len(data) < 4 * lanes or len(data) % 2:
        raise StreamError(f"stream: wanted an even number of at least {4 * lanes} bytes, got {len(data)}")
    states = np.frombuffer(data, "<u4", lanes).astype(np.uint32)
    if (states < FLOOR).any():
        raise StreamError("stream: wanted states of at least 65536")
    return states


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
        self._states = first_states(data, lanes)
        words = np.frombuffer(data, "<u2")
        self.lanes = lanes
        self._words = words.astype(np.uint32)
        self._at = 2 * lanes
        # Constants as arrays: NumPy takes half a microsecond to make one of a number, as long as to go through 512 of them.
        # Low bits are written into the lower halves of wide numbers, which can be added to slots as they are.
        place = np.zeros(lanes, np.intp)
        halves = place.itemsize // 4
        self._work: tuple[np.ndarray, ...] = (
            place.view(np.uint32)[0 if sys.byteorder == "little" else halves - 1 :: halves],
            place,
            np.empty(lanes, np.uint32),
            np.empty(lanes, np.uint32),
            np.empty(lanes, bool),
            np.full(lanes, _LOW),
            np.full(lanes, _SHIFT),
            np.full(lanes, _FLOOR),
        )

    def get(self, tables: Tables, rows: np.ndarray) -> np.ndarray:
        """[m] symbols of the next batch (u8 or u16), each coded by row `rows` [m] of `tables`."""
        first = rows.astype(np.intp)
        first <<= PRECISION
        return self.get_at(tables, first)

    def get_at(self, tables: Tables, first: np.ndarray) -> np.ndarray:
        """As `get`, with the first slot of each row: row * 2^14 ([m] intp, overwritten)."""
        # Few calls on whole arrays: 512 numbers take a quarter of what NumPy takes to be called.
        take, words, begin = tables.moves.take, self._words, self._at
        state, (low_half, place, move, low, empty, lows, shifts, floors) = self._states, self._work
        for at in range(0, len(first), self.lanes):
            slot = first[at : at + self.lanes]
            size = len(slot)
            if size < self.lanes:
                low_half, place, move, low, empty = (a[:size] for a in (low_half, place, move, low, empty))
                state, lows, shifts, floors = (a[:size] for a in (state, lows, shifts, floors))
            np.bitwise_and(state, lows, low_half)
            np.add(slot, place, slot)
            take(slot, None, move, "clip")
            np.right_shift(state, shifts, state)
            np.bitwise_and(move, lows, low)
            np.right_shift(move, shifts, move)
            np.multiply(state, move, state)
            np.add(state, low, state)
            np.less(state, floors, empty)
            places = empty.nonzero()[0]
            if len(places):
                end = begin + len(places)
                if end > len(words):
                    raise StreamError("stream: wanted more words, got its end")
                filled = state.take(places)
                filled <<= _WORD
                filled |= words[begin:end]
                state[places] = filled
                begin = end
        self._at = begin
        return tables.slots.take(first)

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
    freqs: np.ndarray = np.maximum(weights * TOTAL // total, weights > 0)
    order = np.argsort(-freqs, kind="stable")[: np.count_nonzero(weights)]
    missing = TOTAL - int(freqs.sum())
    while missing:
        # Taking away must leave 1.
        able = order if missing > 0 else order[freqs[order] > 1]
        chosen = able[: abs(missing)]
        freqs[chosen] += 1 if missing > 0 else -1
        missing += -len(chosen) if missing > 0 else len(chosen)
    return freqs
