"""Choose the levels of frequency tables, so that symbols and the tables themselves take the fewest bits together.

A table that repeats the one before it is cheap to store. So a frequency may be a little off, if that saves more in the file
than its symbols cost: docs/results/tuning.md#levels
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.codec.v2.tables import CLASSES, LEVELS, OFTEN, WEIGHTS, level_batches, to_levels

ROUNDS = 2
"""How often levels are chosen, each time by what levels cost after the time before."""
_UNSEEN = 0.25
"""A change of levels that no table has yet costs as much as one that comes this often. It would need an entry of its own."""
_UNIT = 2.0**-20
"""Bits are counted in these units. Sums are then exact, and the last digit of a logarithm, in which machines differ, decides
nothing."""


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
    whole: np.ndarray = np.rint(bits / _UNIT) * _UNIT
    return whole


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
    bits: np.ndarray = prices[classes, (levels.astype(np.int64) - before.astype(np.int64)) % LEVELS]
    return bits


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
