"""The dequantize kernel alone against `quantize.dequantize`, which is its specification: every width, odd counts, row ranges."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.constants import DEQUANTIZE_ROWS
from flexgs_edge.packed.quantize import QuantizedArray, dequantize, group_count
from kernel_fixtures import ALL_FORMS, launch, open_form, same_bits
from quantized_scenes import quantize_array

COUNTS = (1, 7, 63, 64, 65, 129, 1000, 2049)


def run(form: str, array: QuantizedArray, first: int, rows: int) -> np.ndarray:
    """[channels, rows] of rows [first, first + rows), as the device gives them."""
    codes = np.concatenate([array.planes.reshape(-1), np.full(3, 0xEE, np.uint8)])
    stride = rows + 5
    *_, values = launch(
        open_form(form), "dequantize", (-(-rows // DEQUANTIZE_ROWS), array.channels), array.count, array.groups, array.bits,
        array.planes.shape[1], first, rows, stride, codes, array.low, array.step,
        np.full((array.channels, stride), -7, np.float32),
    )  # fmt: skip
    assert (values[:, rows:] == -7).all()  # nothing behind the rows asked for
    return values[:, :rows]


def random_array(count: int, channels: int, bits: int, groups: int | None) -> QuantizedArray:
    rng = np.random.default_rng([count, bits])
    values = (rng.normal(size=(channels, count)) * 10.0 ** rng.uniform(-3, 3, (channels, 1))).astype(np.float32)
    return quantize_array(values, bits, group_count(count, groups))


@pytest.mark.parametrize("bits", range(1, 17))
@pytest.mark.parametrize("form", ALL_FORMS)
def test_every_width_and_count(form: str, bits: int) -> None:
    for count in COUNTS:
        array = random_array(count, 3, bits, None if count % 2 else 5)
        assert same_bits(run(form, array, 0, count), dequantize(array, slice(0, count)))


@pytest.mark.parametrize("bits", [1, 3, 4, 8, 11, 16])
@pytest.mark.parametrize("form", ALL_FORMS)
def test_row_ranges(form: str, bits: int) -> None:
    """Ranges that start and end inside bytes, groups and blocks of rows."""
    array = random_array(1001, 2, bits, 9)
    for first, last in ((0, 1), (1, 2), (5, 9), (110, 113), (111, 112), (63, 129), (64, 128), (997, 1001), (1, 1001)):
        assert same_bits(run(form, array, first, last - first), dequantize(array, slice(first, last)))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_as_many_groups_as_rows(form: str) -> None:
    array = random_array(131, 1, 8, 131)
    assert (array.step == 0).all()
    assert same_bits(run(form, array, 0, 131), dequantize(array, slice(0, 131)))


@pytest.mark.parametrize("form", ALL_FORMS)
def test_product_and_sum_are_rounded_apart(form: str) -> None:
    """A fused multiply-add would give other bits here."""
    array = random_array(2049, 1, 8, None)
    wide = array.low.astype(np.float64), array.step.astype(np.float64)
    values = dequantize(array, slice(0, 2049))
    group = ((np.arange(2049) + 1) * array.groups - 1) // 2049
    fused = (array.planes[0].astype(np.float64) * wide[1][0, group] + wide[0][0, group]).astype(np.float32)
    assert (fused != values[0]).any()
    assert same_bits(run(form, array, 0, 2049), values)
