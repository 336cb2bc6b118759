"""Types of option values: sizes, colours, directions, views."""

from __future__ import annotations

import math
import re
from typing import Any

import click

from flexgs_edge.errors import InputError
from flexgs_edge.units import parse_size

COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


class SizeType(click.ParamType):
    """A number of bytes: `1.5MB` (10^6), `512MiB` (2^20) or plain digits."""

    name = "SIZE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            return value if isinstance(value, int) else parse_size(value)
        except InputError as error:
            self.fail(str(error), param, ctx)


class ColourType(click.ParamType):
    """A colour: red, green and blue from 0 to 1."""

    name = "COLOUR"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        text = value.strip().lower()
        if text in COLOURS:
            return COLOURS[text]
        if re.fullmatch(r"#[0-9a-f]{6}", text):
            red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
            return red, green, blue
        parts = text.split(",")
        try:
            numbers = [float(part) for part in parts]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(0.0 <= number <= 1.0 for number in numbers):
            self.fail(f"{value!r}: expected black, white, #rrggbb, or red,green,blue from 0 to 1", param, ctx)
        return numbers[0], numbers[1], numbers[2]


class BoundType(click.ParamType):
    """A number, or `none`."""

    name = "BOUND"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float | str:
        if isinstance(value, str) and value.strip().lower() == "none":
            return "none"
        try:
            return float(value)
        except ValueError:
            self.fail(f"{value!r}: expected a number or none", param, ctx)


class AxisType(click.ParamType):
    """A direction: an axis such as `-y`, or three numbers such as `0,-1,0.2`."""

    name = "AXIS"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"([+-]?)([xyz])", value.strip().lower())
        if match is not None:
            length = -1.0 if match[1] == "-" else 1.0
            x, y, z = (length if axis == match[2] else 0.0 for axis in "xyz")
            return x, y, z
        try:
            numbers = [float(part) for part in value.split(",")]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers) or not any(numbers):
            self.fail(f"{value!r}: expected x, -x, y, -y, z, -z, or three numbers, not all zero: 0,-1,0.2", param, ctx)
        return numbers[0], numbers[1], numbers[2]


class ViewsType(click.ParamType):
    """Indices of views: a list `0,8,16`, a range `0:50:8`, or a mix of both."""

    name = "VIEWS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[int]:
        if isinstance(value, list):
            return value
        chosen: list[int] = []
        for part in value.split(","):
            match = re.fullmatch(r"\s*([0-9]{1,9})(?::([0-9]{1,9})(?::([1-9][0-9]{0,8}))?)?\s*", part)
            if match is None:
                self.fail(
                    f"{value!r}: expected numbers such as 0,8,16 or START:STOP:STEP such as 0:50:8 (STOP left out)",
                    param,
                    ctx,
                )
            start, stop, step = match.groups()
            # Bound the range before making the list: a typing error must not fill the memory.
            last = min(int(stop), 1_000_000) if stop else int(start) + 1
            chosen.extend(range(int(start), last, int(step or 1)))
        return chosen


SIZE, COLOUR, AXIS, BOUND, VIEWS = SizeType(), ColourType(), AxisType(), BoundType(), ViewsType()
