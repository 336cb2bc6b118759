"""The fitted model of a file, and three ports for the walk over a chunk: to collect samples for the fit, to count, to decode."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexgs_edge.codec.v2.fit_groups import Sample
from flexgs_edge.codec.v2.groups import Group, GroupKind, Sums, Term
from flexgs_edge.codec.v2.rans import Decoder, StreamError, Tables
from flexgs_edge.codec.v2.tables import decode_tables, encode_tables, from_levels
from flexgs_edge.codec.v2.walk import OCTREE_CONTEXTS, base_kinds, sh_kinds
from flexgs_edge.constants import CODE_LIMIT
from flexgs_edge.constants import RANS_PRECISION as PRECISION
from flexgs_edge.constants import RANS_TOTAL as TOTAL
from flexgs_edge.memory.rows import put_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage

REPEATS_MOST = 16  # Symbols of the alphabet of repeats; the last one is the escape
SHARED = 2  # Alphabets that come before those of the groups: the octree's and that of the repeats
UNIFORM = [Tables(np.full((1, 1 << bits), TOTAL >> bits)) for bits in range(9)]
"""Tables of raw numbers: for each number of bits, all values are equally likely."""
MOST_HELD = 1 << 24
"""Bytes of batches that a `FitPort` holds in memory before it joins them: docs/results/tuning.md#memory"""

Raw = tuple[int, np.ndarray]
Batch = tuple[int, np.ndarray, np.ndarray, list[Raw]]
"""Alphabet, contexts and symbols of a batch, and the raw batches that follow it."""


@dataclass(frozen=True, eq=False)
class Model:
    """The model section of a file: all that a decoder needs besides the stream of a chunk.

    `sh_degree`, `depth`: SH degree of the scene, and depth of its octree.
    """

    sh_degree: int
    depth: int
    groups: list[Group]  # base channels, then SH
    # For each alphabet, [contexts] u8, the table of every context; alphabets are the octree, the repeats, the groups.
    mappings: list[np.ndarray]
    levels: list[np.ndarray]  # for each alphabet, [tables, symbols] u8, the frequencies as the file stores them
    tables: list[Tables]  # for each alphabet, its frequency tables

    @cached_property
    def slots(self) -> list[np.ndarray]:
        """For each alphabet, the first slot of every context's table, as `Decoder.get_at` takes it."""
        return [mapping.astype(np.intp) << PRECISION for mapping in self.mappings]

    def to_bytes(self, with_sh: bool = True) -> bytes:
        """The model section of a file; `with_sh=False` only serves to compare sizes."""
        chosen = [i for i, group in enumerate(self.groups) if with_sh or not group.kind.sh]
        records = b"".join(self.groups[i].to_bytes() for i in chosen)
        alphabets = [0, 1, *(i + SHARED for i in chosen)]
        return records + encode_tables([self.mappings[i] for i in alphabets], [self.levels[i] for i in alphabets])

    @classmethod
    def from_bytes(cls, data: bytes, sh_degree: int, depth: int) -> "Model":
        """Inverse of `to_bytes`; raises `StreamError` for a damaged model."""
        groups, at = [], 0
        for kind in group_kinds(sh_degree):
            group, at = Group.read(kind, data, at)
            groups.append(group)
        shapes = [(OCTREE_CONTEXTS, 256), (1, REPEATS_MOST), *((g.contexts, g.symbols) for g in groups)]
        pairs = decode_tables(data[at:], shapes)
        levels = [level for _, level in pairs]
        return cls(sh_degree, depth, groups, [mapping for mapping, _ in pairs], levels, list(map(tables_of, levels)))


def group_kinds(sh_degree: int) -> list[GroupKind]:
    """All groups of a scene with this SH degree."""
    return base_kinds() + sh_kinds(sh_degree)


def tables_of(levels: np.ndarray) -> Tables:
    """Tables of an alphabet. If no symbol was counted, the first symbol gets all the frequency and costs nothing."""
    if not levels.any(axis=1).all():
        levels = levels.copy()
        levels[~levels.any(axis=1), 0] = 1
    return from_levels(levels)


def split(codes: np.ndarray, group: Group, base: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Split codes into symbols [m] u8, offsets [m] from the alphabet's lowest code, and the places of escapes."""
    offset = codes - np.float64(base) if isinstance(base, float) else codes - base
    symbols = np.floor(offset * 2.0**-group.shift) if group.shift else offset
    last = group.symbols - 1
    if len(codes) and symbols.min() >= 0 and symbols.max() < last:
        return symbols.astype(np.uint8), offset, np.zeros(0, np.intp)
    escaped = (symbols < 0) | (symbols >= last)
    return np.where(escaped, last, symbols).astype(np.uint8), offset, np.flatnonzero(escaped)


class FitPort:
    """Collects samples (features and codes) for the fit of each group, in `storage`."""

    def __init__(self, groups: list[GroupKind], stride: int, storage: Storage = IN_MEMORY) -> None:
        self.kinds = groups
        self.stride = stride
        self.storage = storage
        self.samples: list[list[Sample]] = [[] for _ in groups]
        self._batches: list[list[Sample]] = [[] for _ in groups]
        self._held = 0

    def put_away(self) -> None:
        """Join the batches so far to one sample of each group. Call it after the last batch."""
        for samples, batches in zip(self.samples, self._batches, strict=True):
            if batches:
                joined = np.concatenate([features for features, _ in batches], axis=1)
                features = self.storage.empty(joined.shape, joined.dtype)
                put_rows(features, slice(0, joined.shape[1]), joined)
                samples.append((features, np.concatenate([codes for _, codes in batches])))
                batches.clear()
        self._held = 0

    def occupancy(self, contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        assert symbols is not None
        return symbols

    def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
        assert codes is not None
        return codes

    def known(self, group: int, count: int, terms: list[Term], before: list[Term] | None = None) -> list[Term]:
        return terms if before is None else before + terms

    def channel(
        self, group: int, known: list[Term], rows: slice, own: tuple[np.ndarray, ...], codes: np.ndarray | None
    ) -> np.ndarray:
        assert codes is not None
        features = np.zeros((self.kinds[group].features, len(codes)), np.float32)
        for place, feature in enumerate(own):
            features[place] = feature
        for term in known:
            features[list(term.places)] = term.values[:, rows]
        # Each pass gives the same share of its rows, so the last passes, which have most rows, weigh most in the fit.
        self._batches[group].append((features, codes.copy()))
        self._held += features.nbytes
        if self._held > MOST_HELD:
            self.put_away()
        return codes


class CountPort:
    """Counts symbols by context, and keeps the batches to code them later."""

    stride = 1

    def __init__(self, groups: list[Group]) -> None:
        self.groups = groups
        shapes = [(OCTREE_CONTEXTS, 256), (1, REPEATS_MOST), *((g.contexts, g.symbols) for g in groups)]
        self.counts = [np.zeros(shape, np.int64) for shape in shapes]
        self.raw = np.zeros(len(shapes))
        self.batches: list[Batch] = []

    def add(self, other: "CountPort") -> None:
        """Add the counts of another port; they are integers, so the order does not matter."""
        for counts, more in zip(self.counts, other.counts, strict=True):
            counts += more
        self.raw += other.raw

    def _add(self, alphabet: int, contexts: np.ndarray, symbols: np.ndarray, raw: list[Raw]) -> None:
        counts = self.counts[alphabet]
        place = contexts.astype(np.intp)
        place *= counts.shape[1]
        place += symbols
        counts += np.bincount(place, minlength=counts.size).reshape(counts.shape)
        self.raw[alphabet] += sum(bits * len(values) for bits, values in raw)
        self.batches.append(
            (alphabet, contexts.astype(np.uint8, copy=False), symbols.astype(np.uint8, copy=False), raw)
        )

    def occupancy(self, contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        assert symbols is not None
        self._add(0, contexts, symbols, [])
        return symbols

    def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
        assert codes is not None
        symbols = np.minimum(codes, REPEATS_MOST - 1)
        raw = _raw(codes[symbols == REPEATS_MOST - 1], 32)
        self._add(1, np.zeros(cells, np.uint8), symbols, raw)
        return codes

    def known(self, group: int, count: int, terms: list[Term], before: Sums | None = None) -> Sums:
        return self.groups[group].known(terms, count, before)

    def channel(
        self, group: int, known: Sums, rows: slice, own: tuple[np.ndarray, ...], codes: np.ndarray | None
    ) -> np.ndarray:
        assert codes is not None
        fitted = self.groups[group]
        base, contexts = fitted.predict(known, rows, own)
        symbols, offset, escaped = split(codes, fitted, base)
        raw = _raw(offset[escaped], 32)
        if fitted.shift:
            raw = _raw(np.delete(offset, escaped), fitted.shift) + raw
        self._add(group + SHARED, contexts, symbols, raw)
        return codes


def _raw(values: np.ndarray, bits: int) -> list[Raw]:
    """Split off the low `bits` of integers [m], in batches of at most 8 bits, lowest first."""
    if len(values) == 0 or bits == 0:
        return []
    values = values.astype(np.int64)
    return [
        (min(bits - at, 8), (values >> at & (1 << min(bits - at, 8)) - 1).astype(np.uint8)) for at in range(0, bits, 8)
    ]


class DecodePort:
    """Decodes batches; with `cost`, it adds up the bits of each alphabet."""

    stride = 1

    def __init__(self, model: Model, stream: Decoder, cost: np.ndarray | None = None) -> None:
        self.model = model
        self.stream = stream
        self.cost = cost

    def _get(self, alphabet: int, contexts: np.ndarray) -> np.ndarray:
        symbols = self.stream.get_at(self.model.tables[alphabet], self.model.slots[alphabet].take(contexts))
        if self.cost is not None:
            rows = self.model.mappings[alphabet][contexts]
            self.cost[alphabet] += self.model.tables[alphabet].bits(rows, symbols)
        return symbols

    def _raw(self, alphabet: int, count: int, bits: int) -> np.ndarray:
        values = np.zeros(count, np.int64)
        if count == 0:
            return values
        for at in range(0, bits, 8):
            part = self.stream.get(UNIFORM[min(bits - at, 8)], np.zeros(count, np.uint8))
            values |= part.astype(np.int64) << at
        if self.cost is not None:
            self.cost[alphabet] += bits * count
        return values

    def occupancy(self, contexts: np.ndarray, symbols: np.ndarray | None) -> np.ndarray:
        occupied = self._get(0, contexts)
        if not occupied.all():
            raise StreamError("octree: wanted nodes with children, got one without")
        return occupied

    def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
        symbols = self._get(1, np.zeros(cells, np.uint8)).astype(np.int64)
        escaped = symbols == REPEATS_MOST - 1
        symbols[escaped] = self._raw(1, int(escaped.sum()), 32)
        if int(symbols.sum()) + cells != rows:
            raise StreamError(f"repeats: wanted {rows - cells} in all, got {int(symbols.sum())}")
        return symbols

    def known(self, group: int, count: int, terms: list[Term], before: Sums | None = None) -> Sums:
        return self.model.groups[group].known(terms, count, before)

    def channel(
        self, group: int, known: Sums, rows: slice, own: tuple[np.ndarray, ...], codes: np.ndarray | None
    ) -> np.ndarray:
        fitted = self.model.groups[group]
        base, contexts = fitted.predict(known, rows, own)
        symbols = self._get(group + SHARED, contexts)
        last = fitted.symbols - 1
        if (
            isinstance(base, float)
            and not fitted.shift
            and abs(base) + last <= CODE_LIMIT
            and not (symbols == last).any()
        ):
            # Most symbols: values of a short alphabet, which fit in i32 without a check or rounding.
            return symbols.astype(np.int32) + np.int32(base)
        offset = symbols.astype(np.float64)
        if fitted.shift:
            offset *= float(1 << fitted.shift)
        escaped = np.flatnonzero(symbols == fitted.symbols - 1)
        count = len(escaped)
        if fitted.shift:
            plain = np.delete(np.arange(len(symbols)), escaped)
            offset[plain] += self._raw(group + SHARED, len(plain), fitted.shift)
        if count:
            offset[escaped] = self._raw(group + SHARED, count, 32).astype(np.uint32).astype(np.int32)
        offset += base
        if len(offset) and not -CODE_LIMIT <= offset.min() <= offset.max() <= CODE_LIMIT:
            raise StreamError(f"{fitted.kind.name}: wanted codes within {CODE_LIMIT}")
        return offset
