"""Fit a model to a grid scene and encode its chunks."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from flexgs_edge.codec.v2.device.encode_kernels import CountKernel, encode_streams
from flexgs_edge.codec.v2.device.launch import Device
from flexgs_edge.codec.v2.fit_groups import fit_group
from flexgs_edge.codec.v2.groups import Group
from flexgs_edge.codec.v2.header import CHUNK_ROWS, Chunk, least_bytes, plan_chunks
from flexgs_edge.codec.v2.ports import SHARED, UNIFORM, Batch, CountPort, FitPort, Model, group_kinds, tables_of
from flexgs_edge.codec.v2.rans import Encoder, lane_count
from flexgs_edge.codec.v2.tables import CLASSES, LEVELS, OFTEN, WEIGHTS, level_batches, merge_contexts, to_levels
from flexgs_edge.codec.v2.threads import in_order, thread_count
from flexgs_edge.codec.v2.walk import ChunkCodes, base_kinds, walk_chunk, walk_positions
from flexgs_edge.constants import RANS_PRECISION as PRECISION
from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import POSITION_BITS
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.memory.rows import blocks, put_rows, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, Storage
from flexgs_edge.scene.curve import morton

ROUNDS = 2  # How often levels are chosen, each time by what levels cost after the time before
_UNSEEN = 0.25
"""A change of levels that no table has yet costs as much as one that comes this often. It would need an entry of its own."""
_UNIT = 2.0**-20
"""Bits are counted in these units. Sums are then exact, and the last digit of a logarithm, in which machines differ, decides
nothing."""
SAMPLE_CHUNKS = 4
"""Chunks that the predictions are fitted to; the tables count the symbols of all chunks. With fewer, layers of a small file
are left out: docs/results/tuning.md#codec"""
SAMPLE_ROWS = 24576
"""Rows of these chunks that the fit uses, or up to twice as many. All rows would take longer and save hardly a bit:
docs/results/tuning.md#codec"""


def fit_levels(counts: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Levels of all alphabets.

    `counts`: for each alphabet, [t, a] i64, the symbols of each table; t is at least 1. Returns for each alphabet, [t,
    a] u8. A symbol that was counted has a level above 0.
    """
    levels = [to_levels(rows) for rows in counts]
    for _ in range(ROUNDS):
        prices = _prices(levels)
        levels = [_chosen(own, rows, prices) for own, rows in zip(levels, counts, strict=True)]
    return levels


def _in_units(bits: np.ndarray) -> np.ndarray:
    return np.rint(bits / _UNIT) * _UNIT


def _prices(levels: Sequence[np.ndarray]) -> np.ndarray:
    """[4, 65] f64, bits of each change of a level, for each class of levels."""
    seen = np.full((CLASSES - 1, LEVELS), _UNSEEN)
    for rows in levels:
        for classes, changes in level_batches(rows):
            np.add.at(seen, (classes, changes), 1)
    return _in_units(np.log2(seen.sum(axis=1, keepdims=True)) - np.log2(seen))


def _chosen(levels: np.ndarray, counts: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """Levels [t, a] of one alphabet, table by table, where `levels` are those of the round before."""
    result = levels.copy()
    for i, row in enumerate(counts):
        if not row.any():
            continue
        bits = _symbol_bits(row, levels[i])
        if i + 1 < len(counts):
            bits += _change_bits(np.arange(LEVELS)[:, None], result[i + 1][None], prices)
        if i:
            bits += _change_bits(result[i - 1][None], np.arange(LEVELS)[:, None], prices)
            result[i] = np.argmin(bits, axis=0)
        else:
            result[i] = cheapest_path(bits, prices[0])
    return result


def _symbol_bits(counts: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """[65, a] f64, bits of a table's symbols for each level that theirs might have, but for a constant.

    Any weight makes all other symbols dearer. The tangent at the table's present sum of weights tells by how much.
    """
    dearer = counts.sum() / (WEIGHTS[levels].sum() * np.log(2))
    bits: np.ndarray = (
        _in_units(WEIGHTS * dearer)[:, None] - counts * _in_units(np.log2(np.maximum(WEIGHTS, 1)))[:, None]
    )
    bits[0, counts > 0] = np.inf
    return bits


def _change_bits(before: np.ndarray, levels: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """Bits of levels behind those of the table before."""
    classes = 1 + (before > 0) + (before > OFTEN)
    return prices[classes, (levels.astype(np.int64) - before.astype(np.int64)) % LEVELS]


def cheapest_path(bits: np.ndarray, prices: np.ndarray) -> np.ndarray:
    """Levels [a] of a first table, where each is stored as its change from the symbol before (Viterbi 1967)."""
    # Ways to a level lie side by side, since most of the time goes into finding the least of them.
    changes = prices[(np.arange(LEVELS)[:, None] - np.arange(LEVELS)[None]) % LEVELS]
    total, came = bits[:, 0] + changes[:, 0], []
    ways, rows = np.empty_like(changes), LEVELS * np.arange(LEVELS)
    for own in bits.T[1:]:
        np.add(changes, total, ways)
        came.append(ways.argmin(axis=1))
        total = ways.take(rows + came[-1]) + own
    path = [int(total.argmin())]
    for back in reversed(came):
        path.append(int(back[path[-1]]))
    return np.array(path[::-1], np.uint8)


def cells_of(grid: GridScene, storage: Storage = IN_MEMORY) -> tuple[np.ndarray, np.ndarray, int]:
    """Morton indices of the rows ([n] u64), the lowest cell ([3] i64), and the depth of the cube that holds the scene."""
    if grid.count == 0:
        return np.zeros(0, np.uint64), np.zeros(3, np.int64), 0
    low = grid.position.min(axis=1).astype(np.int64)
    depth = int((grid.position.max(axis=1) - low).max()).bit_length()
    if depth > POSITION_BITS:
        raise InputError(f"position: the scene is 2^{depth} cells wide, expected at most 2^{POSITION_BITS}")
    index = storage.empty((grid.count,), np.uint64)
    for rows in blocks(grid.count):
        put_rows(index, rows, morton(read_rows(grid.position, rows) - low[:, None]))
    sorted_ = True
    for rows in blocks(grid.count):
        both = slice(max(rows.start - 1, 0), rows.stop)
        steps, some = np.diff(grid.layer[both].astype(np.int16)), read_rows(index, both)
        sorted_ &= not ((steps < 0).any() or (some[1:] < some[:-1])[steps == 0].any())
    if not sorted_:
        raise InputError("grid: expected rows sorted by layer, then by the Morton index of their cell: use to_grid")
    return index, low, depth


def chunk_codes(grid: GridScene, cells: np.ndarray, chunk: Chunk) -> ChunkCodes:
    """Cut the codes of one chunk out of the scene."""
    rows = slice(chunk.start, chunk.stop)
    scale, opacity, dc, rotation = (
        read_rows(values, rows) for values in (grid.scale, grid.opacity, grid.dc, grid.rotation)
    )
    planes = [*scale, opacity, *dc, grid.sh_degrees[rows], *rotation]
    base = {kind.name: plane for kind, plane in zip(base_kinds(), planes, strict=True)}
    sh = []
    for degree, band in enumerate(grid.sh, start=1):
        start = int(np.count_nonzero(grid.sh_degrees[: chunk.start] >= degree))
        sh.append(read_rows(band, slice(start, start + int(np.count_nonzero(base["sh degree"] >= degree)))))
    return ChunkCodes(read_rows(cells, rows), base, tuple(sh))


@dataclass(frozen=True, eq=False)
class Encoded:
    """A fitted model, and the symbols of a scene for its file. `bits` is the information in the symbols of each alphabet."""

    model: Model
    low: np.ndarray
    layers: list[int]
    chunks: list[Chunk]
    batches: list[list[Batch]]
    bits: np.ndarray
    device: Device | None = None  # The device that codes the streams; None for NumPy
    written: tuple[bytes, ...] | None = None  # The coded streams, if they are made already
    threads: int | None = None  # Chunks that NumPy codes at once; None for as many as suit this machine

    @property
    def information(self) -> float:
        """Bytes of the model and the information in all symbols, a lower bound: the streams take a little more."""
        return float(self.bits.sum()) / 8 + len(self.model.to_bytes())

    @property
    def sh_bytes(self) -> float:
        """Bytes of the SH: the information in their symbols and in the rows' SH degrees, and their part of the model.

        A file without SH would be smaller by this, apart from a few bytes of the header and of the lanes.
        """
        if self.model.sh_degree == 0:
            return 0.0
        bits = sum(float(self.bits[i + SHARED]) for i, group in enumerate(self.model.groups) if group.kind.sh)
        return bits / 8 + len(self.model.to_bytes()) - len(self.model.to_bytes(with_sh=False))

    def streams(self) -> Iterator[bytes]:
        """Yield the stream of each chunk in order; each one is coded when it is asked for, or one step earlier."""
        if self.written is not None:
            yield from self.written
            return
        sizes = [chunk.stop - chunk.start for chunk in self.chunks]
        pairs = list(zip(sizes, self.batches, strict=True))
        if self.device is not None and self.device.threads:
            yield from _streams_on(self.device, self.model, pairs)
            return
        yield from in_order(
            lambda pair: encode_chunk(self.model, *pair), pairs, self.threads or thread_count(len(pairs))
        )

    def finished(self) -> "Encoded":
        """A copy that holds the coded streams in place of the symbols, which are several times larger."""
        return replace(self, written=tuple(self.streams()), batches=[])


def encode_grid(
    grid: GridScene,
    chunk_rows: int = CHUNK_ROWS,  # most rows of a chunk
    device: Device | None = None,
    storage: Storage = IN_MEMORY,  # holds the symbols: two or three bytes a code beside the grid
    threads: int | None = None,
) -> Encoded:
    """Fit a model to a scene and count its symbols; `Encoded.streams` then codes the chunks.

    `device`: counts the symbols, with the same result. It takes a kilobyte for each row of the chunks in work.
    `threads`: groups that are fitted at once, and chunks that NumPy codes at once. Default: as many as suit this
    machine.
    """
    cells, low, depth = cells_of(grid, storage)
    layers = np.bincount(grid.layer, minlength=1).tolist()
    chunks = plan_chunks(layers, chunk_rows)
    kinds = group_kinds(grid.sh_degree)
    sample = [chunks[i] for i in sorted({len(chunks) * k // SAMPLE_CHUNKS for k in range(SAMPLE_CHUNKS)}) if chunks]
    fit = FitPort(kinds, max(sum(chunk.stop - chunk.start for chunk in sample) // SAMPLE_ROWS, 1), storage)
    for chunk in sample:
        _walk(grid, cells, chunk, depth, fit)
    fit.put_away()
    # Each takes memory, so that there is one at a time where arrays lie in files.
    at_once = threads or (1 if storage.spills else thread_count(len(kinds)))
    groups = list(in_order(lambda pair: fit_group(*pair), zip(kinds, fit.samples, strict=True), at_once))
    del fit
    if storage.spills:
        trim_heap()  # the threads below have heaps of their own, beside what the fit has left

    def counted(chunk: Chunk) -> CountPort:
        port = CountPort(groups)
        _walk(grid, cells, chunk, depth, port)
        return port

    count = CountPort(groups)
    batches = []
    ports = (
        _counted_on(device, grid, cells, chunks, depth, groups)
        if device is not None and device.threads
        else in_order(counted, chunks, threads or thread_count(len(chunks)))
    )
    for port in ports:
        batches.append(_put_away(port.batches, storage))
        count.add(port)
    merged = [merge_contexts(counts) for counts in count.counts]
    levels = fit_levels(
        [
            counts if len(counts) else np.zeros((1, len(all_[0])), np.int64)
            for (_, counts), all_ in zip(merged, count.counts, strict=True)
        ]
    )
    model = Model(
        grid.sh_degree, depth, groups, [mapping for mapping, _ in merged], levels, list(map(tables_of, levels))
    )
    # A frequency is zero only if the count is zero.
    costs = (
        float((n * (PRECISION - np.log2(np.maximum(t.freqs, 1)))).sum()) for (_, n), t in zip(merged, model.tables)
    )
    return Encoded(model, low, layers, chunks, batches, count.raw + np.array(list(costs)), device, threads=threads)


def _put_away(batches: list[Batch], storage: Storage) -> list[Batch]:
    """Move the batches of a chunk to one array of `storage`."""
    if not storage.spills:
        return batches
    size = sum(len(c) + len(s) + sum(len(values) for _, values in raw) for _, c, s, raw in batches)
    held, at = storage.empty((size,), np.uint8), 0

    def put(values: np.ndarray) -> np.ndarray:
        nonlocal at
        place = slice(at, at + len(values))
        put_rows(held, place, values)
        at = place.stop
        return held[place]

    return [
        (alphabet, put(c), put(s), [(bits, put(values)) for bits, values in raw]) for alphabet, c, s, raw in batches
    ]


def _counted_on(
    device: Device, grid: GridScene, cells: np.ndarray, chunks: list[Chunk], depth: int, groups: list[Group]
) -> Iterator[CountPort]:
    """Yield the ports of all chunks; a device counts their channels."""
    at_once = thread_count(len(chunks))
    rows = max((chunk.stop - chunk.start for chunk in chunks), default=0)
    kernel = CountKernel(device, groups, grid.sh_degree, rows, at_once)

    def counted(first: int) -> list[CountPort]:
        some = chunks[first : first + at_once]
        codes = [chunk_codes(grid, cells, chunk) for chunk in some]
        ports = [CountPort(groups) for _ in some]
        for part, port in zip(codes, ports, strict=True):
            walk_positions(len(part.cells), depth, port, part)
        for i, done in enumerate(kernel.count(codes, ports)):
            if not done:
                ports[i] = CountPort(groups)
                _walk(grid, cells, some[i], depth, ports[i])
        return ports

    try:
        for ports in in_order(counted, range(0, len(chunks), at_once), 1):
            yield from ports
    finally:
        kernel.close()


def _walk(grid: GridScene, cells: np.ndarray, chunk: Chunk, depth: int, port: FitPort | CountPort) -> None:
    codes = chunk_codes(grid, cells, chunk)
    walk_chunk(chunk.stop - chunk.start, depth, grid.sh_degree, port, codes, False)


def encode_chunk(model: Model, rows: int, batches: list[Batch]) -> bytes:
    """The stream of a chunk. It has at least a bit a row, so that the size of a file bounds the rows it can claim."""
    return _fill_encoder(model, rows, batches).finish().ljust(least_bytes(rows), b"\0")


def _fill_encoder(model: Model, rows: int, batches: list[Batch]) -> Encoder:
    encoder = Encoder(lane_count(rows))
    for alphabet, contexts, symbols, raw in batches:
        encoder.put(model.tables[alphabet], model.mappings[alphabet][contexts], symbols)
        for bits, values in raw:
            encoder.put(UNIFORM[bits], np.zeros(len(values), np.uint8), values)
    return encoder


def _streams_on(device: Device, model: Model, pairs: list[tuple[int, list[Batch]]]) -> Iterator[bytes]:
    """`encode_chunk` of all chunks (rows and batches of each) on a device."""
    at_once = thread_count(len(pairs))
    groups = [pairs[first : first + at_once] for first in range(0, len(pairs), at_once)]

    def filled(group: list[tuple[int, list[Batch]]]) -> list[Encoder]:
        return [_fill_encoder(model, *pair) for pair in group]

    for group, encoders in zip(groups, in_order(filled, groups, 1, always=True), strict=True):
        for (rows, _), stream in zip(group, encode_streams(device, encoders), strict=True):
            yield stream.ljust(least_bytes(rows), b"\0")
