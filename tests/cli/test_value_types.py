"""Values of options: views, colours, directions and sizes, and what is none."""

from __future__ import annotations

import click
import pytest

from flexgs_edge.cli import value_types


@pytest.mark.parametrize(
    ("text", "views"),
    [
        ("0,8,16", [0, 8, 16]),
        ("0:50:8", [0, 8, 16, 24, 32, 40, 48]),
        ("3:5", [3, 4]),
        ("7, 0:2", [7, 0, 1]),
        ("5:5", []),
    ],
)
def test_views(text: str, views: list[int]) -> None:
    assert value_types.VIEWS.convert(text, None, None) == views


@pytest.mark.parametrize("text", ["", "a", "-1", "1:2:0", "1::2", "0:99999999999", "1;2"])
def test_views_that_are_none(text: str) -> None:
    with pytest.raises(click.BadParameter, match="START:STOP:STEP"):
        value_types.VIEWS.convert(text, None, None)


@pytest.mark.parametrize(
    ("text", "colour"),
    [("black", (0, 0, 0)), ("White", (1, 1, 1)), ("#ff0080", (1, 0, 128 / 255)), ("0.5,0, 1", (0.5, 0, 1))],
)
def test_colours(text: str, colour: tuple[float, float, float]) -> None:
    assert value_types.COLOUR.convert(text, None, None) == colour


@pytest.mark.parametrize("text", ["", "red", "#fff", "#gggggg", "1,2", "0,0,1.5", "nan,0,0", "a,b,c"])
def test_colours_that_are_none(text: str) -> None:
    with pytest.raises(click.BadParameter, match="black, white"):
        value_types.COLOUR.convert(text, None, None)


@pytest.mark.parametrize(
    ("text", "direction"), [("x", (1, 0, 0)), ("-Y", (0, -1, 0)), ("+z", (0, 0, 1)), ("0,-1, 0.2", (0, -1, 0.2))]
)
def test_directions(text: str, direction: tuple[float, float, float]) -> None:
    assert value_types.AXIS.convert(text, None, None) == direction


@pytest.mark.parametrize("text", ["", "w", "--y", "0,0,0", "1,2", "nan,0,1", "inf,0,0", "a,b,c"])
def test_directions_that_are_none(text: str) -> None:
    with pytest.raises(click.BadParameter, match="not all zero"):
        value_types.AXIS.convert(text, None, None)


def test_sizes_with_units() -> None:
    assert value_types.SIZE.convert("1.5MB", None, None) == 1_500_000
    assert value_types.SIZE.convert("2MiB", None, None) == 2**21
