"""MPQ: bit strings, groups, codes, error bounds."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from flexgs_edge.errors import InputError
from flexgs_edge.packed.bitpack import PAPER, BitSpec, pack, pack_into, plane_bytes, unpack
from flexgs_edge.packed.quantize import (
    LARGEST,
    QuantizedArray,
    dequantize,
    group_bounds,
    group_count,
    group_of,
    quantize_scene,
    quantized_bytes,
)
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import MemorySource
from quantized_scenes import assert_same_codes, largest_error, make_scene, quantize_all, quantize_array

ALL_BITS = range(1, 17)


def plain_codes(values: np.ndarray, bits: int, groups: int) -> tuple[np.ndarray, np.ndarray]:
    """Codes and values of one channel by the formulas of docs/format.md, one number at a time."""
    top, n = 2**bits - 1, len(values)
    out, back = np.zeros(n, np.uint16), np.zeros(n, np.float32)
    for g in range(groups):
        rows = slice(g * n // groups, (g + 1) * n // groups)
        low, high = values[rows].min(), values[rows].max()
        step = np.float32((float(high) - float(low)) / top)
        for i in range(rows.start, rows.stop):
            q = 0 if step < 2.0**-126 else int(np.clip(np.rint((values[i] - low) / step), 0, top))
            out[i], back[i] = q, low + np.float32(q) * step if q else low
    return out, back


def codes(array: QuantizedArray, rows: slice) -> np.ndarray:
    """[c, n] u16, the codes of `rows` (a slice with step 1)."""
    start, stop, _ = rows.indices(array.count)
    out = np.empty((array.channels, max(stop - start, 0)), np.uint16)
    for channel in range(array.channels):
        out[channel] = unpack(array.planes[channel], array.bits, start, stop)
    return out


def bound_by_row(array) -> np.ndarray:  # type: ignore[no-untyped-def]
    return np.repeat(largest_error(array), np.diff(group_bounds(array.count, array.groups)), axis=1)


@pytest.mark.parametrize("bits", ALL_BITS)
def test_packing_against_single_bits(bits: int) -> None:
    rng = np.random.default_rng(bits)
    for n in (0, 1, 7, 8, 9, 64, 333):
        values = rng.integers(0, 2**bits, n).astype(np.uint16)
        single = ((values[:, None] >> np.arange(bits)) & 1).astype(np.uint8).reshape(-1)
        packed = pack(values, bits)
        np.testing.assert_array_equal(packed, np.packbits(single, bitorder="little"))
        assert packed.dtype == np.uint8 and len(packed) == plane_bytes(n, bits)
        for start in {0, 1, 8, 13, n // 2, n}:
            for stop in {start, start + 1, start + 9, n}:
                if start <= stop <= n:
                    np.testing.assert_array_equal(unpack(packed, bits, start, stop), values[start:stop])


@given(st.integers(1, 16), st.lists(st.integers(0, 20), max_size=6), st.integers(0, 2**32 - 1))
def test_packing_in_pieces_of_any_size(bits: int, sizes: list[int], seed: int) -> None:
    values = np.random.default_rng(seed).integers(0, 2**bits, sum(sizes)).astype(np.uint16)
    plane = np.full(plane_bytes(len(values), bits), 0xA5, np.uint8)
    start = 0
    for size in sizes:
        pack_into(plane, bits, start, values[start : start + size])
        start += size
    np.testing.assert_array_equal(plane, pack(values, bits))


def test_bits_texts() -> None:
    assert str(PAPER) == "xyz=16,dc=8,scale=8,rot=8,opacity=4,rest=4"
    assert BitSpec.parse(str(PAPER)) == PAPER
    assert BitSpec.parse(" rest = 3 , xyz=14") == BitSpec(xyz=14, rest=3)
    assert BitSpec.rtn(8) == BitSpec(8, 8, 8, 8, 8, 8)
    assert [PAPER.of(field.name) for field in FIELDS] == [16, 8, 4, 4, 8, 8]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "NAME=NUMBER"),
        ("xyz", "NAME=NUMBER"),
        ("xyz=8,", "NAME=NUMBER"),
        ("xyz=-1", "NAME=NUMBER"),
        ("xyz=²", "NAME=NUMBER"),
        ("colour=8", "xyz, dc, scale, rot, opacity, rest"),
        ("xyz=8,xyz=8", "given twice"),
        ("xyz=0", "1 to 16"),
        ("xyz=17", "1 to 16"),
        ("xyz=" + "9" * 5000, "1 to 16"),
    ],
)
def test_bad_bits_texts(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        BitSpec.parse(text)


@pytest.mark.parametrize(
    ("rows", "groups", "expected"),
    [(0, None, 0), (1, None, 1), (767, None, 1), (769, None, 2), (512000, None, 1000), (0, 4, 0), (3, 4, 3), (9, 1, 1)],
)
def test_group_counts(rows: int, groups: int | None, expected: int) -> None:
    assert group_count(rows, groups) == expected


def test_no_groups_asked_for() -> None:
    with pytest.raises(InputError, match="at least 1"):
        group_count(5, 0)


@given(st.integers(1, 3000), st.data())
def test_every_row_lies_in_its_group(rows: int, data: st.DataObject) -> None:
    groups = data.draw(st.integers(1, rows))
    bounds = group_bounds(rows, groups)
    row = data.draw(st.integers(0, rows - 1))
    assert bounds[0] == 0 and bounds[-1] == rows and (np.diff(bounds) > 0).all()
    group = group_of(row, rows, groups)
    assert bounds[group] <= row < bounds[group + 1]


@pytest.mark.parametrize("bits", ALL_BITS)
def test_codes_follow_the_formulas(bits: int) -> None:
    rng = np.random.default_rng(bits)
    values = (rng.normal(size=(2, 301)) * 10.0 ** rng.integers(-3, 4, (2, 301))).astype(np.float32)
    array = quantize_array(values, bits, 7)
    for channel in range(2):
        expected, back = plain_codes(values[channel], bits, 7)
        np.testing.assert_array_equal(codes(array, slice(None))[channel], expected)
        np.testing.assert_array_equal(dequantize(array, slice(None))[channel], back)


floats = st.floats(-(2.0**126), 2.0**126, width=32)


@settings(deadline=None)
@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 2), st.integers(1, 40)), elements=floats),
    st.integers(1, 16),
    st.data(),
)
def test_error_stays_below_its_bound(values: np.ndarray, bits: int, data: st.DataObject) -> None:
    groups = data.draw(st.integers(1, values.shape[1]))
    array = quantize_array(values, bits, groups)
    back = dequantize(array, slice(None))
    assert back.dtype == np.float32 and np.isfinite(back).all()
    assert (np.abs(back.astype(np.float64) - values) <= bound_by_row(array)).all()
    start = data.draw(st.integers(0, values.shape[1]))
    stop = data.draw(st.integers(start, values.shape[1]))
    np.testing.assert_array_equal(dequantize(array, slice(start, stop)), back[:, start:stop])
    np.testing.assert_array_equal(codes(array, slice(start, stop)), codes(array, slice(None))[:, start:stop])


@pytest.mark.parametrize("scale", [1e-30, 1.0, 1e30])
def test_more_bits_are_never_worse(scale: float) -> None:
    values = (np.random.default_rng(3).normal(size=(3, 2000)) * scale).astype(np.float32)
    last = np.inf
    for bits in ALL_BITS:
        array = quantize_array(values, bits, 4)
        error = np.abs(dequantize(array, slice(None)).astype(np.float64) - values).max()
        assert error < last
        last = error


def test_three_trips_do_not_drift() -> None:
    values = np.random.default_rng(4).normal(size=(2, 700)).astype(np.float32)
    first = quantize_array(values, 6, 3)
    again = first
    for _ in range(3):
        again = quantize_array(dequantize(again, slice(None)), 6, 3)
    np.testing.assert_array_equal(codes(again, slice(None)), codes(first, slice(None)))


def test_constant_groups_are_exact() -> None:
    values = np.repeat(np.array([[0.1, -3e7, 1e-38, 5e37]], np.float32), 5, axis=1)
    array = quantize_array(values, 4, 4)
    assert not array.step.any() and not codes(array, slice(None)).any()
    np.testing.assert_array_equal(dequantize(array, slice(None)), values)


def test_a_step_that_underflows_counts_as_constant() -> None:
    values = np.array([[0.0, 1e-40, 3e-39]], np.float32)
    array = quantize_array(values, 8, 1)
    assert array.step[0, 0] == 0
    np.testing.assert_array_equal(dequantize(array, slice(None)), np.zeros((1, 3), np.float32))


def test_minus_zero_gives_the_same_bytes_as_zero() -> None:
    one = quantize_array(np.array([[-0.0, 0.0, 1.0]], np.float32), 8, 1)
    two = quantize_array(np.array([[0.0, -0.0, 1.0]], np.float32), 8, 1)
    assert one.low.tobytes() == two.low.tobytes() == bytes(4)


def test_the_widest_range_is_finite() -> None:
    array = quantize_array(np.array([[-LARGEST, LARGEST, 0.0]], np.float32), 1, 1)
    back = dequantize(array, slice(None))
    assert np.isfinite(back).all() and back[0, 1] == LARGEST


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 3e38])
def test_values_that_cannot_be_coded(bad: float) -> None:
    values = np.zeros((2, 10), np.float32)
    values[1, 7] = bad
    with pytest.raises(InputError, match="channel 1, kept rows 5 to 9"):
        quantize_array(values, 8, 2)


def test_quaternions_become_unit_with_positive_w() -> None:
    quats = np.array([[-2, 0, 0, 0], [1e30, 1e30, 0, 0], [0, -3, 0, 4], [-1e-30, 0, 1e-30, 0]], np.float32).T
    unit = normalize_quats(quats)
    half = np.float32(np.sqrt(0.5))
    expected = np.array([[1, 0, 0, 0], [half, half, 0, 0], [0, -0.6, 0, 0.8], [half, 0, -half, 0]], np.float32).T
    np.testing.assert_allclose(unit, expected, rtol=1e-7)
    assert unit.dtype == np.float32 and (unit[0] >= 0).all()


def test_zero_quaternion_is_refused() -> None:
    with pytest.raises(InputError, match="1 quaternions are zero"):
        normalize_quats(np.array([[1, 0], [0, 0], [0, 0], [0, 0]], np.float32))


@pytest.mark.parametrize("groups", [None, 1, 5])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_scene_does_not_depend_on_the_chunk_size(groups: int | None, degree: int) -> None:
    scene = make_scene(1600, degree)
    whole = quantize_all(scene, BitSpec(xyz=13, dc=7, scale=8, rot=3, opacity=5, rest=4), groups)
    for chunk_rows in (100, 513, 1600) if groups else (1, 511, 600):
        assert_same_codes(whole, quantize_all(scene, whole.bits, groups, chunk_rows))


def test_scene_equals_the_arrays_one_by_one() -> None:
    scene = make_scene(1500, 2)
    rows_with, rows_without = np.arange(3, 1500, 3), np.arange(1, 1500, 3)
    result = quantize_scene(scene, rows_with, rows_without)
    rows = np.concatenate([rows_with, rows_without])
    for field in FIELDS:
        own = rows_with if field.name == "sh_rest" else rows
        values = scene.read(slice(0, 1500), [field.name])[field.name][:, own]
        if field.name == "quats":
            values = normalize_quats(values)
        expected = quantize_array(values, PAPER.of(field.name), group_count(len(own)))
        array = result.arrays[field.name]
        assert array.planes.tobytes() == expected.planes.tobytes()
        assert array.low.tobytes() == expected.low.tobytes() and array.step.tobytes() == expected.step.tobytes()
    assert (result.count, result.sh_count, result.sh_degree) == (999, 499, 2)
    assert result.arrays["sh_rest"].count == 499 and result.arrays["means"].count == 999
    np.testing.assert_array_equal(result.origin, scene.origin)


def test_memory_is_one_chunk() -> None:
    class Watched(MemorySource):
        most = 0

        def read(self, rows, fields, out=None):  # type: ignore[no-untyped-def]
            planes = super().read(rows, fields, out)
            Watched.most = max(Watched.most, *(plane.shape[1] for plane in planes.values()))
            return planes

    scene = make_scene(3000, 1)
    watched = Watched({f.name: scene.read(slice(0, 3000), [f.name])[f.name] for f in FIELDS})
    quantize_all(watched, groups=1, chunk_rows=128)
    nonzero_reads = Watched.most
    Watched.most = 0
    rows = np.arange(3000)
    quantize_scene(watched, rows[:1000], rows[1000:], PAPER, 1, 128)
    assert 0 < Watched.most <= 128
    assert nonzero_reads == 3000  # make_scene's own look at the SH, to show that the watch works


def test_degree_zero_rows_stay_in_input_order() -> None:
    scene = make_scene(10, 0)
    rows = np.arange(10)
    mixed = quantize_scene(scene, rows[1::2], rows[0::2])
    assert_same_codes(mixed, quantize_scene(scene, rows[:0], rows))
    assert mixed.sh_count == 0


@pytest.mark.parametrize("count", [0, 1])
def test_smallest_scenes(count: int) -> None:
    result = quantize_all(make_scene(count, 1, sh_share=1.0))
    assert result.count == result.sh_count == count
    assert result.sh_degree == count
    assert dequantize(result.arrays["means"], slice(None)).shape == (3, count)


def test_faults_name_scene_and_field() -> None:
    scene = make_scene(20, 1)
    arrays = {f.name: scene.read(slice(0, 20), [f.name])[f.name] for f in FIELDS}
    arrays["log_scales"][2, 5] = np.inf
    with pytest.raises(InputError, match="memory: log_scales: channel 2"):
        quantize_all(MemorySource(arrays))


@given(st.integers(0, 1500), st.integers(0, 4), st.integers(1, 16), st.sampled_from([None, 1, 3, 1000]))
@settings(max_examples=25, deadline=None)
def test_size_model_is_exact(count: int, degree: int, bits: int, groups: int | None) -> None:
    spec = BitSpec(xyz=bits, rot=17 - bits, rest=bits)
    result = quantize_all(make_scene(count, degree), spec, groups)
    expected = sum(array.nbytes for array in result.arrays.values())
    assert quantized_bytes(result.count, result.sh_count, result.sh_degree, spec, groups) == expected
