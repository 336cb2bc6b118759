"""The rANS coder: round trips, its size against entropy, and streams that no encoder wrote."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexgs_edge.codec.v2 import rans
from flexgs_edge.codec.v2.encode import cheapest_path, fit_levels
from flexgs_edge.codec.v2.rans import Decoder, Encoder, StreamError, Tables, lane_count, normalize
from flexgs_edge.codec.v2.tables import LEVELS, decode_tables, encode_tables, from_levels, merge_contexts, to_levels
from flexgs_edge.constants import RANS_TOTAL as TOTAL


def some_tables(rows: int = 3, size: int = 9, seed: int = 0) -> Tables:
    rng = np.random.default_rng(seed)
    return Tables(np.array([normalize(rng.integers(0, 50, size) ** 3 + 1) for _ in range(rows)]))


def some_symbols(tables: Tables, count: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    rows = rng.integers(0, len(tables.freqs), count)
    return rows, tables.slots[rows * TOTAL + rng.integers(0, TOTAL, count)]


@pytest.mark.parametrize("size", [9, 256, 257])
def test_bytes_of_decoding_are_those_of_both_lists(size: int) -> None:
    tables = some_tables(size=size)
    assert tables.decoding_bytes == tables.slots.nbytes + tables.moves.nbytes


@pytest.mark.parametrize("lanes", [1, 2, 64, 512])
@pytest.mark.parametrize("counts", [(), (0,), (1,), (5, 0, 513), (64, 63, 65), (2000,)])
def test_round_trip_in_batches(lanes: int, counts: tuple[int, ...]) -> None:
    tables = some_tables()
    encoder = Encoder(lanes)
    batches = [some_symbols(tables, count, seed) for seed, count in enumerate(counts)]
    for rows, symbols in batches:
        encoder.put(tables, rows, symbols)
    data = encoder.finish()
    decoder = Decoder(data + b"\0\0", lanes)
    for rows, symbols in batches:
        np.testing.assert_array_equal(decoder.get(tables, rows), symbols)
    assert decoder.finish() == len(data)


@pytest.mark.parametrize("lanes", [1, 3, 8])
def test_few_lanes_give_the_bytes_of_many(lanes: int, monkeypatch: pytest.MonkeyPatch) -> None:
    tables = some_tables()
    encoder = Encoder(lanes)
    for seed, count in enumerate((7, 0, 400, 8)):
        encoder.put(tables, *some_symbols(tables, count, seed))
    few = encoder.finish()
    monkeypatch.setattr(rans, "FEW_LANES", 0)
    assert encoder.finish() == few


def test_size_is_that_of_the_information() -> None:
    tables = some_tables(16, 40)
    rows, symbols = some_symbols(tables, 50_000)
    encoder = Encoder(64)
    encoder.put(tables, rows, symbols)
    assert 8 * len(encoder.finish()) <= tables.bits(rows, symbols) * 1.0005 + 32 * 64


def test_a_certain_symbol_costs_nothing() -> None:
    tables = Tables(np.array([[0, TOTAL, 0]]))
    encoder = Encoder(2)
    encoder.put(tables, np.zeros(10_000, np.uint8), np.ones(10_000, np.uint8))
    assert len(encoder.finish()) == 8


def test_every_truncation_and_flip_is_noticed_or_decodes_to_something_else() -> None:
    tables = some_tables()
    rows, symbols = some_symbols(tables, 100)
    encoder = Encoder(2)
    encoder.put(tables, rows, symbols)
    data = encoder.finish()
    for length in range(len(data)):
        with pytest.raises(StreamError):
            decoder = Decoder(data[:length], 2)
            decoder.get(tables, rows)
    for bit in range(8 * len(data)):
        bad = bytearray(data)
        bad[bit // 8] ^= 1 << bit % 8
        try:
            decoder = Decoder(bytes(bad), 2)
            assert (decoder.get(tables, rows) != symbols).any() or decoder.finish() != len(data)
        except StreamError:
            pass


def test_a_symbol_without_frequency_is_a_bug() -> None:
    with pytest.raises(AssertionError):
        Encoder(1).put(Tables(np.array([[0, TOTAL]])), np.zeros(1, np.uint8), np.zeros(1, np.uint8))


@given(st.lists(st.integers(0, 1 << 40), min_size=1, max_size=256).filter(any))
def test_normalize(weights: list[int]) -> None:
    freqs = normalize(weights)
    assert freqs.sum() == TOTAL
    np.testing.assert_array_equal(freqs > 0, np.array(weights) > 0)


@pytest.mark.parametrize("weights", [[], [0], [0, 0], [-1, 5]])
def test_weights_that_are_none(weights: list[int]) -> None:
    with pytest.raises(StreamError):
        normalize(weights)


def test_frequencies_must_add_up() -> None:
    with pytest.raises(StreamError):
        Tables(np.array([[1, 2]]))


def test_lanes_cost_little() -> None:
    assert all(4 * lane_count(rows) <= 0.005 * rows * 52 / 8 + 4 for rows in range(0, 200_000, 777))
    assert lane_count(65536) >= 256


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(1, 12), st.integers(1, 40)), max_size=4))
def test_stored_tables(seed: int, shapes: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(seed)
    mappings, levels = [], []
    for contexts, size in shapes:
        counts = rng.poisson(rng.gamma(0.3, 30, (contexts, size)))
        mapping, merged = merge_contexts(counts)
        assert merged.sum() == counts.sum()
        for context in np.flatnonzero(counts.any(axis=1)):
            assert np.all(merged[mapping[context]] >= counts[context])
        mappings.append(mapping)
        levels.append(to_levels(merged if len(merged) else np.zeros((1, size), np.int64)))
        if merged.any():
            assert np.all(from_levels(levels[-1]).freqs[merged > 0] > 0)
    if not shapes:
        return
    data = encode_tables(mappings, levels)
    for (mapping, rows), a, b in zip(decode_tables(data, shapes), mappings, levels, strict=True):
        np.testing.assert_array_equal(mapping, a)
        np.testing.assert_array_equal(rows, b)
    with pytest.raises(StreamError):
        decode_tables(data + b"\0\0", shapes)


def test_levels_cost_little() -> None:
    counts = np.random.default_rng(0).poisson(3000 * np.exp(-abs(np.arange(-20, 21)) / 5))[None]
    share = counts / counts.sum()
    freqs = from_levels(to_levels(counts)).freqs / TOTAL
    assert (share * np.log2(share / freqs)).sum() < 0.005


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32), st.lists(st.tuples(st.integers(1, 9), st.integers(1, 40)), min_size=1, max_size=4))
def test_fitted_levels_hold_every_symbol(seed: int, shapes: list[tuple[int, int]]) -> None:
    rng = np.random.default_rng(seed)
    counts = [rng.poisson(rng.gamma(0.3, 30, shape)) for shape in shapes]
    levels = fit_levels(counts)
    for own, rows in zip(levels, counts, strict=True):
        assert own.dtype == np.uint8 and own.shape == rows.shape and own.max() < LEVELS
        assert np.all(own[rows > 0] > 0)
        assert not own[~rows.any(axis=1)].any()


def test_fitted_levels_take_fewer_bytes_with_their_symbols() -> None:
    rng = np.random.default_rng(3)
    widths = np.linspace(2, 9, 6)[:, None]
    counts = [rng.poisson(12 * np.exp(-abs(np.arange(-20, 21)) / widths)) for _ in range(4)]
    mappings = [np.arange(6, dtype=np.uint8)] * 4

    def size(levels: list[np.ndarray]) -> float:
        freqs = [from_levels(own).freqs for own in levels]
        bits = sum((rows * (14 - np.log2(np.maximum(own, 1)))).sum() for rows, own in zip(counts, freqs, strict=True))
        return float(bits / 8 + len(encode_tables(mappings, levels)))

    assert size(fit_levels(counts)) < 0.97 * size([to_levels(rows) for rows in counts])


def test_the_cheapest_path_is_the_best_of_all() -> None:
    rng = np.random.default_rng(0)
    bits, prices = rng.random((LEVELS, 3)) * 9, rng.random(LEVELS) * 9
    bits[5:] = 1e12
    best = min(
        itertools.product(range(5), repeat=3),
        key=lambda path: sum(
            bits[level, k] + prices[(level - before) % LEVELS]
            for k, (before, level) in enumerate(itertools.pairwise((0, *path)))
        ),
    )
    assert cheapest_path(bits, prices).tolist() == list(best)


def test_equal_contexts_are_merged_and_different_ones_kept() -> None:
    a, b = np.array([900, 100, 0]), np.array([5, 5, 2000])
    mapping, merged = merge_contexts(np.array([a, b, 2 * a, 0 * a, b]))
    assert mapping.tolist() == [0, 1, 0, 0, 1]
    np.testing.assert_array_equal(merged, [3 * a, 2 * b])
