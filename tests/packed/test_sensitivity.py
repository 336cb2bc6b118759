"""`--bits auto` over made-up errors."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from flexgs_edge.packed.bitspec import BitSpec, search_bits
from flexgs_edge.quality.psnr import error_for_drop

RISE = {"dc": 8e-6, "scale": 4e-4, "rot": 9e-5, "opacity": 1e-6, "rest": 3e-6}
"""Rise of the error when one attribute alone is at 4 bits."""


class Errors:
    """An error that is the sum of the rises of the attributes at 4 bits."""

    def __init__(self, rise: dict[str, float], floor: float = 1e-6) -> None:
        self.rise, self.floor = rise, floor
        self.asked: list[BitSpec] = []

    def __call__(self, bits: BitSpec) -> float:
        self.asked.append(bits)
        return self.floor + sum(rise for name, rise in self.rise.items() if asdict(bits)[name] == 4)


def test_moves_in_ascending_order_while_the_sum_stays_below() -> None:
    errors = Errors(RISE)
    bits, found = search_bits(errors, 3, 1.0, error_for_drop(0.3, 36.0))
    # rest: 45 channels share its rise; then opacity, dc. rot would break the limit of 1.8e-5.
    assert [item.attribute for item in found] == ["rest", "opacity", "dc", "rot", "scale"]
    assert [item.moved for item in found] == [True, True, True, False, False]
    assert bits == BitSpec(xyz=16, dc=4, scale=8, rot=8, opacity=4, rest=4)
    assert found[0].loss == pytest.approx(3e-6 / 180)


def test_each_attribute_alone_from_8_bits() -> None:
    errors = Errors(RISE)
    search_bits(errors, 3, 1.0, 1e-5)
    assert errors.asked[0] == BitSpec(16, 8, 8, 8, 8, 8)
    assert len(errors.asked) == 6
    assert all(sorted(asdict(bits).values()) == [4, 8, 8, 8, 8, 16] for bits in errors.asked[1:])


def test_stops_at_the_first_that_does_not_fit() -> None:
    bits, found = search_bits(Errors({**RISE, "opacity": 1e-3, "scale": 2.1e-3}), 3, 1.0, 5e-4)
    moved = [item.attribute for item in found if item.moved]
    assert moved == [item.attribute for item in found][: len(moved)]
    assert bits.opacity == 8


def test_degree_zero_has_no_sh_to_save_on() -> None:
    bits, found = search_bits(Errors(RISE), 0, 0.0, 1.0)
    assert "rest" not in [item.attribute for item in found] and bits.rest == 8


def test_a_share_of_sh_counts_for_that_share() -> None:
    _, all_rows = search_bits(Errors(RISE), 3, 1.0, 1.0)
    _, a_tenth = search_bits(Errors(RISE), 3, 0.1, 1.0)
    loss = {item.attribute: item.loss for item in all_rows}
    assert {item.attribute: item.loss for item in a_tenth}["rest"] == pytest.approx(10 * loss["rest"])


def test_noise_below_the_floor_is_no_gain() -> None:
    _, found = search_bits(lambda bits: 1e-6 - 1e-9 * (bits.dc == 4), 1, 1.0, 1e-5)
    assert all(item.rise == 0.0 for item in found)
