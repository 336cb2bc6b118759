"""The real coder: fit a model to a grid scene, encode its chunks, decode them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexgs_edge.codec import octree
from flexgs_edge.codec.features import Sums, Term
from flexgs_edge.codec.groups import Group, GroupKind, fit_group
from flexgs_edge.codec.rans import PRECISION, TOTAL, Decoder, Encoder, StreamError, Tables, lane_count
from flexgs_edge.codec.tables import decode_tables, encode_tables, from_levels, merge_contexts, to_levels
from flexgs_edge.codec.walk import ChunkCodes, base_kinds, sh_kinds, walk_chunk
from flexgs_edge.errors import InputError
from flexgs_edge.grid import CODE_LIMIT, POSITION_BITS, GridScene, morton

CHUNK_ROWS = 65536
SAMPLE_CHUNKS = 2
"""Chunks that the predictions are fitted to; tables count all of them."""
SAMPLE_ROWS = 16384
"""About as many rows of each of them are fitted to: all rows cost four times the time for 0.01 bits a Gaussian."""
REPEATS_MOST = 16
"""Symbols of the repeats; the last is the escape."""
UNIFORM = [Tables(np.full((1, 1 << bits), TOTAL >> bits)) for bits in range(9)]
"""Numbers of so many bits that are all equally likely."""

_SHARED = 2
"""Alphabets before those of the groups: of the octree, and of the repeats."""

_Raw = tuple[int, np.ndarray]
_Batch = tuple[int, np.ndarray, np.ndarray, list[_Raw]]
"""Alphabet, contexts, symbols, and raw batches behind them."""


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows [start, stop) of a scene, all of one layer."""

    layer: int
    start: int
    stop: int


def plan_chunks(layers: list[int], chunk_rows: int = CHUNK_ROWS) -> list[Chunk]:
    """The chunks of a scene whose layers have these numbers of rows."""
    chunks, at = [], 0
    for layer, count in enumerate(layers):
        for start in range(at, at + count, chunk_rows):
            chunks.append(Chunk(layer, start, min(start + chunk_rows, at + count)))
        at += count
    return chunks


@dataclass(frozen=True, eq=False)
class Model:
    """Everything that chunks are decoded with.

    Parameters
    ----------
    sh_degree, depth : int
        Of the scene and of its octree.
    groups : list of Group
        Base channels, then SH.
    mappings : list of np.ndarray
        The table of every context: of the octree, the repeats, then of the groups.
    levels : list of np.ndarray
        Levels of the tables, in the same order.
    tables : list of Tables
        The tables.
    """

    sh_degree: int
    depth: int
    groups: list[Group]
    mappings: list[np.ndarray]
    levels: list[np.ndarray]
    tables: list[Tables]

    @cached_property
    def slots(self) -> list[np.ndarray]:
        """First slot of the table of every context, as `Decoder.get_at` takes it."""
        return [mapping.astype(np.intp) << PRECISION for mapping in self.mappings]

    def to_bytes(self, with_sh: bool = True) -> bytes:
        """The model section of a file; without SH only to compare sizes."""
        chosen = [i for i, group in enumerate(self.groups) if with_sh or not group.kind.sh]
        records = b"".join(self.groups[i].to_bytes() for i in chosen)
        alphabets = [0, 1, *(i + _SHARED for i in chosen)]
        return records + encode_tables([self.mappings[i] for i in alphabets], [self.levels[i] for i in alphabets])

    @classmethod
    def from_bytes(cls, data: bytes, sh_degree: int, depth: int) -> Model:
        """Inverse of `to_bytes`; raises `StreamError`."""
        groups, at = [], 0
        for kind in group_kinds(sh_degree):
            group, at = Group.read(kind, data, at)
            groups.append(group)
        shapes = [(octree.CONTEXTS, 256), (1, REPEATS_MOST), *((g.contexts, g.symbols) for g in groups)]
        pairs = decode_tables(data[at:], shapes)
        levels = [level for _, level in pairs]
        return cls(sh_degree, depth, groups, [mapping for mapping, _ in pairs], levels, list(map(_tables, levels)))


def group_kinds(sh_degree: int) -> list[GroupKind]:
    """All groups of a scene of this degree."""
    return base_kinds() + sh_kinds(sh_degree)


def _tables(levels: np.ndarray) -> Tables:
    """Tables of an alphabet; one that nothing was counted for gets its first symbol, which costs nothing."""
    if not levels.any(axis=1).all():
        levels = levels.copy()
        levels[~levels.any(axis=1), 0] = 1
    return from_levels(levels)


def split(codes: np.ndarray, group: Group, base: np.ndarray | float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbols [m] u8, offsets [m] from the alphabet's lowest code in f64, and where symbols are escapes."""
    offset = codes - np.float64(base) if isinstance(base, float) else codes - base
    symbols = np.floor(offset * 2.0**-group.shift) if group.shift else offset
    last = group.symbols - 1
    if len(codes) and symbols.min() >= 0 and symbols.max() < last:
        return symbols.astype(np.uint8), offset, np.zeros(0, np.intp)
    escaped = (symbols < 0) | (symbols >= last)
    return np.where(escaped, last, symbols).astype(np.uint8), offset, np.flatnonzero(escaped)


class _FitPort:
    """Collects samples."""

    def __init__(self, groups: list[GroupKind], stride: int) -> None:
        self.kinds = groups
        self.stride = stride
        self.samples: list[list[tuple[list[np.ndarray], np.ndarray]]] = [[] for _ in groups]

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
        # Of every pass the same share: the weights are to fit the last ones, which have most rows.
        self.samples[group].append((list(features), codes.copy()))
        return codes


class _CountPort:
    """Counts symbols by context, and keeps the batches."""

    stride = 1

    def __init__(self, groups: list[Group]) -> None:
        self.groups = groups
        shapes = [(octree.CONTEXTS, 256), (1, REPEATS_MOST), *((g.contexts, g.symbols) for g in groups)]
        self.counts = [np.zeros(shape, np.int64) for shape in shapes]
        self.raw = np.zeros(len(shapes))
        self.batches: list[_Batch] = []

    def _add(self, alphabet: int, contexts: np.ndarray, symbols: np.ndarray, raw: list[_Raw]) -> None:
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
        self._add(group + _SHARED, contexts, symbols, raw)
        return codes


def _raw(values: np.ndarray, bits: int) -> list[_Raw]:
    """The low `bits` of integers [m], at most 8 a batch, lowest first."""
    if len(values) == 0 or bits == 0:
        return []
    values = values.astype(np.int64)
    return [
        (min(bits - at, 8), (values >> at & (1 << min(bits - at, 8)) - 1).astype(np.uint8)) for at in range(0, bits, 8)
    ]


class _DecodePort:
    """Decodes batches, counting what each alphabet costs if asked."""

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
        symbols = self._get(group + _SHARED, contexts)
        offset = symbols.astype(np.float64)
        if fitted.shift:
            offset *= float(1 << fitted.shift)
        escaped = np.flatnonzero(symbols == fitted.symbols - 1)
        count = len(escaped)
        if fitted.shift:
            plain = np.delete(np.arange(len(symbols)), escaped)
            offset[plain] += self._raw(group + _SHARED, len(plain), fitted.shift)
        if count:
            offset[escaped] = self._raw(group + _SHARED, count, 32).astype(np.uint32).astype(np.int32)
        offset += base
        if len(offset) and not -CODE_LIMIT <= offset.min() <= offset.max() <= CODE_LIMIT:
            raise StreamError(f"{fitted.kind.name}: wanted codes within {CODE_LIMIT}")
        return offset


def cells_of(grid: GridScene) -> tuple[np.ndarray, np.ndarray, int]:
    """[n] u64 Morton indices, the lowest cell [3] i64, and the depth of the cube that holds the scene."""
    if grid.count == 0:
        return np.zeros(0, np.uint64), np.zeros(3, np.int64), 0
    low = grid.position.min(axis=1).astype(np.int64)
    cells = grid.position - low[:, None]
    depth = int(cells.max()).bit_length()
    if depth > POSITION_BITS:
        raise InputError(f"position: the scene is 2^{depth} cells wide, expected at most 2^{POSITION_BITS}")
    index = morton(cells)
    steps = np.diff(grid.layer.astype(np.int16))
    if (steps < 0).any() or (index[1:] < index[:-1])[steps == 0].any():
        raise InputError("grid: expected rows sorted by layer, then by the Morton index of their cell: use to_grid")
    return index, low, depth


def chunk_codes(grid: GridScene, cells: np.ndarray, chunk: Chunk) -> ChunkCodes:
    """The codes of one chunk (views)."""
    rows = slice(chunk.start, chunk.stop)
    planes = [*grid.scale, grid.opacity, *grid.dc, grid.sh_degrees, *grid.rotation]
    base = {kind.name: plane[rows] for kind, plane in zip(base_kinds(), planes, strict=True)}
    sh = []
    for degree, band in enumerate(grid.sh, start=1):
        start = int(np.count_nonzero(grid.sh_degrees[: chunk.start] >= degree))
        sh.append(band[:, start : start + int(np.count_nonzero(base["sh degree"] >= degree))])
    return ChunkCodes(cells[rows], base, tuple(sh))


@dataclass(frozen=True, eq=False)
class Encoded:
    """A grid scene in memory as it will lie in a file; `bits` is the information in the symbols of each alphabet."""

    model: Model
    low: np.ndarray
    layers: list[int]
    chunks: list[Chunk]
    batches: list[list[_Batch]]
    bits: np.ndarray

    @property
    def sh_bytes(self) -> float:
        """What the SH cost: the information in their symbols (the rows' degrees among them), and their part of the model."""
        if self.model.sh_degree == 0:
            return 0.0
        bits = sum(float(self.bits[i + _SHARED]) for i, group in enumerate(self.model.groups) if group.kind.sh)
        return bits / 8 + len(self.model.to_bytes()) - len(self.model.to_bytes(with_sh=False))

    def streams(self) -> Iterator[bytes]:
        """The bytes of every chunk, made one by one."""
        for chunk, batches in zip(self.chunks, self.batches, strict=True):
            yield encode_chunk(self.model, chunk.stop - chunk.start, batches)


def encode_grid(grid: GridScene, chunk_rows: int = CHUNK_ROWS) -> Encoded:
    """Fit a model to a scene and count its symbols; `Encoded.streams` gives the chunks.

    Holds two or three bytes a coded number beside the grid itself.
    """
    cells, low, depth = cells_of(grid)
    layers = np.bincount(grid.layer, minlength=1).tolist()
    chunks = plan_chunks(layers, chunk_rows)
    kinds = group_kinds(grid.sh_degree)
    fit = _FitPort(kinds, max(min(grid.count, chunk_rows) // SAMPLE_ROWS, 1))
    for i in sorted({len(chunks) * k // SAMPLE_CHUNKS for k in range(SAMPLE_CHUNKS)} if chunks else ()):
        _walk(grid, cells, chunks[i], depth, fit)
    groups = [fit_group(kind, samples) for kind, samples in zip(kinds, fit.samples, strict=True)]
    del fit
    count = _CountPort(groups)
    batches = []
    for chunk in chunks:
        _walk(grid, cells, chunk, depth, count)
        batches.append(count.batches)
        count.batches = []
    merged = [merge_contexts(counts) for counts in count.counts]
    levels = [
        to_levels(counts if len(counts) else np.zeros((1, len(all_[0])), np.int64))
        for (_, counts), all_ in zip(merged, count.counts, strict=True)
    ]
    model = Model(grid.sh_degree, depth, groups, [mapping for mapping, _ in merged], levels, list(map(_tables, levels)))
    # Zero frequencies belong to zero counts.
    costs = (
        float((n * (PRECISION - np.log2(np.maximum(t.freqs, 1)))).sum()) for (_, n), t in zip(merged, model.tables)
    )
    return Encoded(model, low, layers, chunks, batches, count.raw + np.array(list(costs)))


def _walk(grid: GridScene, cells: np.ndarray, chunk: Chunk, depth: int, port: _FitPort | _CountPort) -> None:
    codes = chunk_codes(grid, cells, chunk)
    walk_chunk(chunk.stop - chunk.start, depth, grid.sh_degree, port, codes, False)


def encode_chunk(model: Model, rows: int, batches: list[_Batch]) -> bytes:
    """The stream of a chunk: at least a bit a row, so that a file's size bounds the rows that it can claim."""
    encoder = Encoder(lane_count(rows))
    for alphabet, contexts, symbols, raw in batches:
        encoder.put(model.tables[alphabet], model.mappings[alphabet][contexts], symbols)
        for bits, values in raw:
            encoder.put(UNIFORM[bits], np.zeros(len(values), np.uint8), values)
    return encoder.finish().ljust(least_bytes(rows), b"\0")


def least_bytes(rows: int) -> int:
    """Smallest size of the chunk of so many rows: even, and a bit a row."""
    return -(-rows // 16) * 2


def decode_chunk(
    model: Model, rows: int, data: bytes, base_only: bool = False, cost: np.ndarray | None = None
) -> ChunkCodes:
    """The codes of a chunk; raises `StreamError` for bytes that no encoder wrote.

    Parameters
    ----------
    model : Model
        Of the file.
    rows : int
        Rows of the chunk.
    data : bytes
        All of the chunk.
    base_only : bool, optional
        Leave out the SH.
    cost : np.ndarray, optional
        [alphabets] f64: bits of each alphabet are added to it.
    """
    stream = Decoder(data, lane_count(rows))
    codes = walk_chunk(rows, model.depth, model.sh_degree, _DecodePort(model, stream, cost), None, base_only)
    if not base_only:
        used = stream.finish()
        if any(data[used:]) or (len(data) > used and len(data) != least_bytes(rows)):
            raise StreamError(f"stream: wanted {used} bytes, got {len(data)}")
    return codes
