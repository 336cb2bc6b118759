"""Types of option values: sizes, colours, directions, views."""

import math
import re
from collections.abc import Callable
from typing import Any

import click

from flexgs_edge.errors import InputError
from flexgs_edge.units import parse_size

COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


class Parsed(click.ParamType):
    """Values that `parse` makes of a text; its `InputError` says what was expected."""

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name, self.parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return self.parse(value) if isinstance(value, str) else value
        except InputError as error:
            self.fail(str(error), param, ctx)


def _numbers(text: str) -> list[float]:
    """The numbers of a list; none if it has other words."""
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        return []


def _colour(value: str) -> tuple[float, ...]:
    """Red, green and blue from 0 to 1."""
    text = value.strip().lower()
    if text in COLOURS:
        return COLOURS[text]
    if re.fullmatch(r"#[0-9a-f]{6}", text):
        return tuple(int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
    numbers = _numbers(text)
    if len(numbers) != 3 or not all(0.0 <= number <= 1.0 for number in numbers):
        raise InputError(f"{value!r}: expected black, white, #rrggbb, or red,green,blue from 0 to 1")
    return tuple(numbers)


def _bound(value: str) -> float | str:
    """A number, or `none`."""
    if value.strip().lower() == "none":
        return "none"
    try:
        return float(value)
    except ValueError:
        raise InputError(f"{value!r}: expected a number or none") from None


def _axis(value: str) -> tuple[float, ...]:
    """A direction: an axis such as `-y`, or three numbers such as `0,-1,0.2`."""
    match = re.fullmatch(r"([+-]?)([xyz])", value.strip().lower())
    if match is not None:
        length = -1.0 if match[1] == "-" else 1.0
        return tuple(length if axis == match[2] else 0.0 for axis in "xyz")
    numbers = _numbers(value)
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers) or not any(numbers):
        raise InputError(f"{value!r}: expected x, -x, y, -y, z, -z, or three numbers, not all zero: 0,-1,0.2")
    return tuple(numbers)


def _views(value: str) -> list[int]:
    """Indices of views: a list `0,8,16`, a range `0:50:8`, or a mix of both."""
    chosen: list[int] = []
    for part in value.split(","):
        match = re.fullmatch(r"\s*([0-9]{1,9})(?::([0-9]{1,9})(?::([1-9][0-9]{0,8}))?)?\s*", part)
        if match is None:
            raise InputError(
                f"{value!r}: expected numbers such as 0,8,16 or START:STOP:STEP such as 0:50:8 (STOP left out)"
            )
        start, stop, step = match.groups()
        # Bound the range before making the list: a typing error must not fill the memory.
        last = min(int(stop), 1_000_000) if stop else int(start) + 1
        chosen.extend(range(int(start), last, int(step or 1)))
    return chosen


def _ratios(value: str) -> tuple[float, ...]:
    """Ratios `8,16,32`, or none."""
    if value.strip().lower() == "none":
        return ()
    numbers = _numbers(value)
    if not numbers:
        raise InputError(f"{value!r}: expected ratios such as 8,16,32, or none")
    return tuple(numbers)


SIZE, COLOUR, AXIS = Parsed("SIZE", parse_size), Parsed("COLOUR", _colour), Parsed("AXIS", _axis)
BOUND, VIEWS, RATIOS = Parsed("BOUND", _bound), Parsed("VIEWS", _views), Parsed("LIST", _ratios)
