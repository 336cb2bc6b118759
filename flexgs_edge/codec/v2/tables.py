"""Store frequency tables in a file: frequencies are rounded to few levels, and coded with the table before as context."""

from collections.abc import Sequence

import numpy as np

from flexgs_edge.codec.v2.rans import Decoder, Encoder, StreamError, Tables, normalize

LEVELS = 65
"""Levels of a frequency. Level 0 means absent; level v stands for the weight (4 + (v - 1) % 4) << (v - 1) // 4, in
steps of 14 to 25 %. Finer levels would cost more bytes in the file than they save: docs/results/tuning.md#codec"""
SYMBOLS_MOST = 256
CONTEXTS_MOST = 64
ENTRY_BITS = 4.0
"""Bits that one frequency should save; contexts are merged until their tables pay: docs/results/tuning.md#levels"""

CLASSES = 5
"""Classes of a level: in the first table; in later ones, if the level above is absent, rare or often; in a mapping."""
OFTEN = 20
_LANES = 16
WEIGHTS = np.array([0] + [(4 + (v - 1) % 4) << ((v - 1) // 4) for v in range(1, LEVELS)], np.int64)


def merge_contexts(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge contexts greedily as long as it saves bits: symbols cost more, but fewer frequencies are stored.

    `counts`: [c, a] i64, symbols counted in each context. Returns [c] u8, the table of each context, and [t, a] i64,
    the counts of each table; t is 0 if no symbol was counted. Tables are numbered by their first context. A context
    without symbols takes the first table.
    """
    used = np.flatnonzero(counts.any(axis=1))
    merged = np.array(counts[used], np.int64)
    owner = np.arange(len(used))
    costs = _costs(merged)
    alive = np.ones(len(used), bool)
    gains = np.full((len(used), len(used)), -np.inf)
    for i in range(len(used) - 1):
        gains[i, i + 1 :] = costs[i] + costs[i + 1 :] - _costs(merged[i] + merged[i + 1 :])
    while len(used) > 1 and gains.max() >= 0:
        i, j = (int(place) for place in np.unravel_index(int(np.argmax(gains)), gains.shape))
        merged[i] += merged[j]
        owner[owner == j] = i
        alive[j] = False
        costs[i] = _costs(merged[i : i + 1])[0]
        gains[j], gains[:, j] = -np.inf, -np.inf
        others = np.flatnonzero(alive & (np.arange(len(used)) != i))
        gain = costs[i] + costs[others] - _costs(merged[i] + merged[others])
        gains[np.minimum(i, others), np.maximum(i, others)] = gain
    mapping = np.zeros(len(counts), np.uint8)
    mapping[used] = np.cumsum(alive)[owner] - 1
    return mapping, merged[alive]


def _costs(counts: np.ndarray) -> np.ndarray:
    """Bits of the symbols and of their table ([t]), for counts [t, a]."""
    total = counts.sum(axis=1)
    logs = np.log2(np.maximum(counts, 1))
    cost: np.ndarray = total * np.log2(np.maximum(total, 1)) - (counts * logs).sum(axis=1)
    cost += ENTRY_BITS * np.count_nonzero(counts, axis=1)
    return cost


def to_levels(counts: np.ndarray) -> np.ndarray:
    """Round counts [t, a] to levels [t, a] u8, relative to the sum of each table."""
    total = np.maximum(counts.sum(axis=1, keepdims=True), 1)
    target = counts * (1 << 17) // total
    middles = (WEIGHTS[1:] + np.append(WEIGHTS[2:], WEIGHTS[-1] * 2)) // 2
    levels = 1 + np.searchsorted(middles[:-1], target)
    return np.where(counts > 0, levels, 0).astype(np.uint8)


def from_levels(levels: np.ndarray) -> Tables:
    """Frequency tables of levels [t, a], in integers, so that all decoders agree."""
    return Tables(np.array([normalize(WEIGHTS[row]) for row in levels]).reshape(len(levels), -1))


def level_batches(levels: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Classes and changes ([a] u8 each) of the levels of each table of an alphabet ([t, a])."""
    batches = []
    for i, row in enumerate(levels):
        classes, before = _expect(levels[i - 1] if i else None, row.size)
        ahead = np.concatenate([[0], row[:-1]]) if before is None else before
        batches.append((classes, ((row.astype(np.int64) - ahead) % LEVELS).astype(np.uint8)))
    return batches


def encode_tables(mappings: Sequence[np.ndarray], levels: Sequence[np.ndarray]) -> bytes:
    """Code the mappings and levels of all alphabets in one small stream.

    `mappings`: for each alphabet, [c] u8, the table of each context. `levels`: for each alphabet, [t, a] u8.
    """
    batches = []
    for mapping, rows in zip(mappings, levels, strict=True):
        batches.append((np.full(len(mapping), CLASSES - 1, np.uint8), mapping))
        batches += level_batches(rows)
    counts = np.zeros((CLASSES, LEVELS), np.int64)
    for classes, symbols in batches:
        np.add.at(counts, (classes, symbols), 1)
    meta = to_levels(counts)
    tables = _meta_tables(meta)
    encoder = Encoder(_LANES)
    for classes, symbols in batches:
        encoder.put(tables, classes, symbols)
    head = b"".join(bytes([_used(row)]) + row[: _used(row)].tobytes() for row in meta)
    return head + encoder.finish()


def decode_tables(data: bytes, shapes: Sequence[tuple[int, int]]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Inverse of `encode_tables`: (mapping, levels) of each alphabet; raises `StreamError` for damaged data.

    `data`: nothing may follow the stream. `shapes`: number of contexts and of symbols, for each alphabet.
    """
    meta, at = np.zeros((CLASSES, LEVELS), np.uint8), 0
    for row in meta:
        length = data[at] if at < len(data) else LEVELS + 1
        part = np.frombuffer(data[at + 1 : at + 1 + length], np.uint8)
        if length > LEVELS or len(part) < length or part.max(initial=0) >= LEVELS:
            raise StreamError(f"tables: byte {at}: wanted at most {LEVELS} levels below {LEVELS}")
        row[:length] = part
        at += 1 + length
    tables = _meta_tables(meta)
    decoder = Decoder(data[at:], _LANES)
    result = []
    for contexts, size in shapes:
        mapping = decoder.get(tables, np.full(contexts, CLASSES - 1, np.uint8))
        count = int(mapping.max(initial=0)) + 1
        if count > contexts:
            raise StreamError(f"tables: wanted at most {contexts}, got {count}")
        rows = np.zeros((count, size), np.uint8)
        for i, row in enumerate(rows):
            classes, before = _expect(rows[i - 1] if i else None, size)
            symbols = decoder.get(tables, classes).astype(np.int64)
            row[:] = (np.cumsum(symbols) if before is None else symbols + before) % LEVELS
        result.append((mapping, rows))
    if decoder.finish() != len(data) - at:
        raise StreamError("tables: wanted their end, got more bytes")
    return result


def _expect(before: np.ndarray | None, size: int) -> tuple[np.ndarray, np.ndarray | None]:
    """Classes [a] of a table's symbols, and the levels of the table before it (None for the first table)."""
    if before is None:
        return np.zeros(size, np.uint8), None
    return (1 + (before > 0).astype(np.uint8) + (before > OFTEN)).astype(np.uint8), before


def _meta_tables(meta: np.ndarray) -> Tables:
    """Tables of the classes; in an unused class, all symbols have the same frequency."""
    filled = np.where(meta.any(axis=1, keepdims=True), meta, 1)
    return from_levels(filled)


def _used(row: np.ndarray) -> int:
    return int(np.flatnonzero(row)[-1]) + 1 if row.any() else 0
