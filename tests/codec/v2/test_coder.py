"""The real coder in memory: exact round trips, sizes near or below entropy, and models and streams that are not ours."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flexgs_edge.codec.v2 import fit_groups
from flexgs_edge.codec.v2.container import decode_chunk
from flexgs_edge.codec.v2.encode import cells_of, chunk_codes, encode_grid
from flexgs_edge.codec.v2.ports import FitPort, Model
from flexgs_edge.codec.v2.rans import StreamError
from flexgs_edge.codec.v2.walk import TooManyNodes
from flexgs_edge.errors import InputError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.rows import blocks
from flexgs_edge.memory.storage import ScratchStorage
from grid_scenes import make_grid


def check_trip(grid: GridScene, chunk_rows: int = 65536) -> int:
    """Encode, decode, compare; returns the bytes of all chunks."""
    encoded = encode_grid(grid, chunk_rows)
    model = Model.from_bytes(encoded.model.to_bytes(), encoded.model.sh_degree, encoded.model.depth)
    cells = cells_of(grid)[0]
    total = 0
    for chunk, data in zip(encoded.chunks, encoded.streams(), strict=True):
        wanted = chunk_codes(grid, cells, chunk)
        for base_only in (False, True):
            got = decode_chunk(model, chunk.stop - chunk.start, data, base_only)
            np.testing.assert_array_equal(got.cells, wanted.cells)
            for name, codes in wanted.base.items():
                np.testing.assert_array_equal(got.base[name], codes, name)
            assert len(got.sh) == (0 if base_only else len(wanted.sh))
            for a, b in zip(got.sh, wanted.sh, strict=False):
                np.testing.assert_array_equal(a, b)
        total += len(data)
    return total


@pytest.mark.parametrize("count", [0, 1, 2, 3, 17, 255, 256, 257, 513, 3000])
@pytest.mark.parametrize("degree", [0, 3])
def test_round_trip(count: int, degree: int) -> None:
    check_trip(make_grid(count, degree))


def test_predictions_are_fitted_to_every_layer_of_a_small_file(monkeypatch: pytest.MonkeyPatch) -> None:
    chunks: list[int] = []

    class Port(FitPort):
        def repeats(self, codes: np.ndarray | None, cells: int, rows: int) -> np.ndarray:
            chunks.append(rows)
            return super().repeats(codes, cells, rows)

    monkeypatch.setattr("flexgs_edge.codec.v2.encode.FitPort", Port)
    grid = make_grid(2000, 1, layers=4)
    encode_grid(grid)
    assert chunks == np.bincount(grid.layer).tolist()


def test_parts_and_files_fit_the_same_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    grid = make_grid(3000, 2, layers=2)
    wanted = encode_grid(grid).model.to_bytes()
    monkeypatch.setattr(fit_groups, "blocks", partial(blocks, rows=100))
    assert encode_grid(grid, storage=ScratchStorage(tmp_path, least=1)).model.to_bytes() == wanted


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 900), st.integers(0, 4), st.integers(1, 4), st.sampled_from([1, 7, 256, 300]), st.integers(0, 99))
def test_round_trips(count: int, degree: int, layers: int, chunk_rows: int, seed: int) -> None:
    if count > 100 and chunk_rows < 100:
        count %= 100
    check_trip(make_grid(count, degree, seed, layers), chunk_rows)


@settings(max_examples=12, deadline=None)
@given(st.integers(0, 1000), st.lists(st.tuples(st.integers(0, 299), st.integers(-(1 << 24), 1 << 24)), max_size=6))
def test_outliers_survive(seed: int, outliers: list[tuple[int, int]]) -> None:
    grid = make_grid(300, 1, seed)
    for i, (row, value) in enumerate(outliers):
        (grid.opacity, grid.scale[1], grid.dc[0], grid.rotation[2], grid.sh[0][4])[i % 5][row % 100] = value
    check_trip(grid)


def test_one_outlier_costs_little() -> None:
    grid = make_grid(3000, 1)
    before = check_trip(grid)
    for plane in (grid.opacity, *grid.scale, *grid.dc, *grid.sh[0]):
        plane[7] = 10**6
    assert check_trip(grid) < before + 17 * 120


def test_rows_in_one_cell() -> None:
    grid = make_grid(200, 1)
    grid.position[:] = 5
    check_trip(grid)
    check_trip(grid, 64)


def test_constant_channels_cost_nothing() -> None:
    grid = make_grid(5000, 0)
    varied = check_trip(grid)
    for plane in (*grid.scale, *grid.dc, grid.opacity):
        plane[:] = -123456
    constant = check_trip(grid)
    for plane in grid.rotation:
        plane[:] = 3
    positions = check_trip(grid)
    assert positions < constant < varied
    grid.position[:] = 0
    # What is left is the smallest chunk that the format allows, one bit a row.
    assert check_trip(grid) == 2 * (-(-5000 // 16))


def test_fine_steps_have_raw_bits() -> None:
    grid = make_grid(2000, 1)
    rng = np.random.default_rng(0)
    for plane in (grid.opacity, grid.dc[1], grid.sh[0][0]):
        plane[:] = rng.integers(-(2**13), 2**13, plane.shape)
    assert check_trip(grid) > 2000 * 2 * 13 / 8


def test_predictions_beat_order_0() -> None:
    """Each channel that follows its neighbours costs less than its entropy, tables included."""
    grid = make_grid(4000, 0)
    rng = np.random.default_rng(3)
    grid.dc[:] = np.cumsum(rng.integers(-2, 3, grid.dc.shape), axis=1)
    encoded = encode_grid(grid)
    cost = np.zeros(len(encoded.model.tables))
    decode_chunk(encoded.model, grid.count, next(encoded.streams()), cost=cost)
    for alphabet, plane in zip((6, 7, 8), grid.dc, strict=True):
        share = np.unique(plane, return_counts=True)[1] / grid.count
        assert cost[alphabet] < 0.75 * grid.count * -(share * np.log2(share)).sum()


def test_equal_scenes_give_equal_bytes() -> None:
    one, two = encode_grid(make_grid(700)), encode_grid(make_grid(700))
    assert one.model.to_bytes() == two.model.to_bytes()
    assert list(one.streams()) == list(two.streams())


def test_rows_out_of_order() -> None:
    grid = make_grid(50)
    for broken in (
        replace(grid, position=grid.position[:, ::-1].copy()),
        replace(grid, layer=np.arange(50, 0, -1).astype(np.uint8)),
    ):
        with pytest.raises(InputError, match="expected rows sorted by layer"):
            encode_grid(broken)


def test_damaged_models_and_streams_raise_one_error() -> None:
    """Checksums find damage first; behind them nothing but `StreamError` may come."""
    grid = make_grid(120, 1)
    encoded = encode_grid(grid)
    good, data = encoded.model.to_bytes(), next(encoded.streams())
    rng = np.random.default_rng(0)
    for _ in range(150):
        broken, stream = bytearray(good), bytearray(data)
        for target, chance in ((broken, 0.5), (stream, 0.7)):
            if rng.random() < chance:
                at = int(rng.integers(len(target)))
                target[at : at + int(rng.integers(1, 5))] = rng.bytes(int(rng.integers(0, 6)))
        try:
            model = Model.from_bytes(bytes(broken), 1, encoded.model.depth)
            codes = decode_chunk(model, 120, bytes(stream))
            assert len(codes.cells) == 120
        except (StreamError, TooManyNodes):
            pass
    for length in range(0, len(good), 3):
        with pytest.raises(StreamError):
            Model.from_bytes(good[:length], 1, encoded.model.depth)
