"""Range asymmetric numeral systems (rANS; Duda 2013) over many lanes at once, with static tables and integers only.

States have 32 bits and stay at or above 2^16, words have 16 bits, and probabilities are in 1/2^14. Every batch of
symbols starts at lane 0 and goes round the lanes. One vector operation moves all lanes by one symbol, so that NumPy's
overhead is paid once a round.
"""

import sys
from collections.abc import Sequence
from functools import cached_property
from typing import Any

import numpy as np

from flexgs_edge.constants import RANS_FLOOR as FLOOR
from flexgs_edge.constants import RANS_LANES as LANES_MOST
from flexgs_edge.constants import RANS_PRECISION as PRECISION
from flexgs_edge.constants import RANS_TOTAL as TOTAL

_LOW, _SHIFT, _WORD = np.uint32(TOTAL - 1), np.uint32(PRECISION), np.uint32(16)
_FLOOR = np.uint32(FLOOR)
FEW_LANES = 8
"""Up to so many lanes are coded by Python's integers: a call of NumPy takes longer than a few symbols.
docs/results/tuning.md#memory"""


def lane_count(rows: int) -> int:
    """Lanes of a stream of `rows` rows: a power of two, at most one for 128 rows.

    A lane costs 4 bytes, so all lanes cost below 0.5 %.

    >>> [lane_count(rows) for rows in (0, 127, 256, 65536, 10**6)]
    [1, 1, 2, 512, 512]
    """
    return min(1 << max((rows // 128).bit_length() - 1, 0), LANES_MOST)


class StreamError(ValueError):
    """A stream that no encoder writes; the message tells what was wanted and what was found."""


class Tables:
    """Frequency tables of one alphabet. `freqs`: [t, a] integers: t tables of a <= 2^16 symbols. Every row adds up to 2^14."""

    def __init__(self, freqs: np.ndarray) -> None:
        self.freqs = np.ascontiguousarray(freqs, np.uint32)
        if self.freqs.ndim != 2 or not np.all(self.freqs.sum(axis=1, dtype=np.int64) == TOTAL):
            raise StreamError(f"frequencies: wanted rows that add up to {TOTAL}")
        self.size = self.freqs.shape[1]
        starts = np.zeros_like(self.freqs)
        np.cumsum(self.freqs[:, :-1], axis=1, out=starts[:, 1:])
        self.entries = ((self.freqs << _SHIFT) | starts).reshape(-1)
        """[t * a] u32, frequency and start of every symbol; 0 if the frequency is 0."""

    @property
    def decoding_bytes(self) -> int:
        """Bytes of `slots` and `moves`, which a decoder makes."""
        return len(self.freqs) * TOTAL * (self._kind.itemsize + 4)

    @property
    def _kind(self) -> np.dtype[Any]:
        return np.dtype(np.uint8 if self.size <= 256 else np.uint16)

    @cached_property
    def slots(self) -> np.ndarray:
        """[t * 2^14], the symbol of every slot of every table."""
        symbols = np.tile(np.arange(self.size, dtype=self._kind), len(self.freqs))
        return np.repeat(symbols, self.freqs.reshape(-1))

    @cached_property
    def moves(self) -> np.ndarray:
        """[t * 2^14] u32, for every slot the frequency of its symbol and the slot's place in it: one look-up a decoded symbol."""
        freqs = self.freqs.reshape(-1)
        moves = np.repeat((freqs << _SHIFT) - (self.entries & _LOW), freqs)
        moves.reshape(-1, TOTAL)[:] += np.arange(TOTAL, dtype=np.uint32)
        return moves

    def bits(self, tables: np.ndarray, symbols: np.ndarray) -> float:
        """Information of symbols in bits; in floating point, so for reports only."""
        return float((PRECISION - np.log2(self.freqs[tables, symbols])).sum())


class Encoder:
    """Collects batches of symbols in decoding order, and codes them backwards. `lanes`: from `lane_count`."""

    def __init__(self, lanes: int) -> None:
        self.lanes = lanes
        self.batches: list[np.ndarray] = []  # frequency and start of every symbol ([m] u32), batch by batch

    def put(self, tables: Tables, rows: np.ndarray, symbols: np.ndarray) -> None:
        """Add a batch: `symbols` [m], each with its table `rows` [m] in `tables`. A symbol of frequency 0 is a bug."""
        place = rows.astype(np.intp)
        place *= tables.size
        place += symbols
        entries = tables.entries.take(place)
        if not entries.all():
            raise AssertionError("a symbol without a frequency")
        self.batches.append(entries)

    def finish(self) -> bytes:
        """Code the stream: the states of all lanes as u32, then the words as u16."""
        states, words = self._few_lanes() if self.lanes <= FEW_LANES else self._many_lanes()
        return np.concatenate([states.astype("<u4").view("<u2"), *words]).tobytes()

    def _few_lanes(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """States, and words in their order, by Python's integers."""
        states, rounds = [FLOOR] * self.lanes, list[list[int]]()
        for entries in reversed(self.batches):
            freqs, starts = (entries >> _SHIFT).tolist(), (entries & _LOW).tolist()
            for at in range((len(freqs) - 1) // self.lanes * self.lanes, -1, -self.lanes):
                words = []
                for lane, freq in enumerate(freqs[at : at + self.lanes]):
                    state = states[lane]
                    if state >= freq << (32 - PRECISION):
                        words.append(state & 0xFFFF)
                        state >>= 16
                    states[lane] = (state // freq << PRECISION) + state % freq + starts[at + lane]
                rounds.append(words)
        ordered = [word for words in reversed(rounds) for word in words]
        return np.array(states), [np.array(ordered, "<u2")]

    def _many_lanes(self) -> tuple[np.ndarray, list[np.ndarray]]:
        """States, and words in their order, by arrays of all lanes."""
        # f64 holds states exactly, and its division is a vector instruction. A quotient cannot round up to the next
        # integer, since states are far below 2^53.
        states = np.full(self.lanes, float(FLOOR))
        quotient, full = np.empty(self.lanes), np.empty(self.lanes, bool)
        words = []
        for entries in reversed(self.batches):
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
        return states, words[::-1]


def first_states(data: bytes, lanes: int) -> np.ndarray:
    """Read and check the [lanes] u32 states at the head of a stream."""
    if len(data) < 4 * lanes or len(data) % 2:
        raise StreamError(f"stream: wanted an even number of at least {4 * lanes} bytes, got {len(data)}")
    states = np.frombuffer(data, "<u4", lanes).astype(np.uint32)
    if (states < FLOOR).any():
        raise StreamError("stream: wanted states of at least 65536")
    return states


class Decoder:
    """Decodes the batches of an `Encoder` in order.

    `data`: the stream, and padding that may follow it. `lanes`: as in the encoder.
    """

    def __init__(self, data: bytes, lanes: int) -> None:
        self._states = first_states(data, lanes)
        words = np.frombuffer(data, "<u2")
        self.lanes = lanes
        self._words = words.astype(np.uint32)
        self._at = 2 * lanes
        # Constants are arrays, since NumPy converts a Python number to an array in every call. Low bits are written
        # into the lower halves of wide integers, which can be added to slots as they are.
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
        """Decode the next batch: [m] symbols (u8 or u16), each with its table `rows` [m] in `tables`."""
        first = rows.astype(np.intp)
        first <<= PRECISION
        return self.get_at(tables, first)

    def get_at(self, tables: Tables, first: np.ndarray) -> np.ndarray:
        """As `get`, with the first slot of each table, row * 2^14 ([m] intp, overwritten)."""
        # Few calls on whole arrays: a call costs NumPy more than its work on 512 numbers.
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
        """Return the bytes read; raises `StreamError` unless every lane is back in its first state."""
        if (self._states != FLOOR).any():
            raise StreamError("stream: wanted every lane to end in its first state")
        return 2 * self._at


def normalize(weights: Sequence[int] | np.ndarray) -> np.ndarray:
    """Frequencies in proportion to `weights` [a], with the sum 2^14 and at least 1 for each weight above 0.

    Each frequency is the floor of its share, but at least 1. The rest, positive or negative, goes to the largest
    frequencies in turn, one unit each; of equal ones the first comes first. Integers only, so that all decoders agree.
    """
    weights = np.asarray(weights, np.int64)
    total = int(weights.sum())
    if total <= 0 or np.count_nonzero(weights) > TOTAL // 2 or weights.min() < 0 or total >= 1 << 48:
        raise StreamError("weights: wanted some above 0")
    freqs: np.ndarray = np.maximum(weights * TOTAL // total, weights > 0)
    order = np.argsort(-freqs, kind="stable")[: np.count_nonzero(weights)]
    missing = TOTAL - int(freqs.sum())
    while missing:
        # A frequency may not fall below 1.
        able = order if missing > 0 else order[freqs[order] > 1]
        chosen = able[: abs(missing)]
        freqs[chosen] += 1 if missing > 0 else -1
        missing += -len(chosen) if missing > 0 else len(chosen)
    return freqs
