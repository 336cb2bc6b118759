"""Objects of a JSON file: values of the expected kind, or an error that names the file and the place in it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from flexgs_edge.errors import FormatError, brief

MOST = 2**53  # Largest whole number that JSON's floats hold exactly


class JsonObject:
    """One object of the JSON; every method raises `FormatError`.

    `name`: the file, for messages. `value`: must be an object. `place`: where it lies in the file, such as `accessors[3]`.
    """

    def __init__(self, name: str, value: Any, place: str = "") -> None:
        self.name, self.place = name, place
        if not isinstance(value, dict):
            raise FormatError(f"{name}: {place or 'top level'}: expected an object, found {brief(value)}")
        self.value: dict[str, Any] = value

    def __contains__(self, key: str) -> bool:
        """Whether the key exists and its value is not null."""
        return self.value.get(key) is not None

    def place_of(self, key: str) -> str:
        """Where the value of a key lies in the file."""
        return f"{self.place}.{key}" if self.place else key

    def fail(self, key: str, expected: str, *found: object) -> FormatError:
        """Make the error for a value that is missing or wrong; `found`: what stands for the value in the message."""
        words = brief(found[0] if found else self.value[key]) if found or key in self.value else "no such field"
        return FormatError(f"{self.name}: {self.place_of(key)}: expected {expected}, found {words}")

    def needed(self, key: str) -> JsonObject:
        """The object of a key."""
        if key not in self.value:
            raise self.fail(key, "an object")
        return JsonObject(self.name, self.value[key], self.place_of(key))

    def inner(self, key: str) -> JsonObject:
        """The object of a key; an empty one if it is missing."""
        return self.needed(key) if key in self else JsonObject(self.name, {}, self.place_of(key))

    def items(self, key: str) -> list[Any]:
        """The list of a key; an empty one if it is missing."""
        value = self.value[key] if key in self else []
        if not isinstance(value, list):
            raise self.fail(key, "a list")
        return value

    def item(self, key: str, index: int, asker: str) -> JsonObject:
        """One object of the list of a key, which `asker` refers to."""
        values = self.items(key)
        if not 0 <= index < len(values):
            raise FormatError(
                f"{self.name}: {asker}: refers to {key}[{index}], but the file has {len(values)} {key}; is it complete?"
            )
        return JsonObject(self.name, values[index], f"{self.place_of(key)}[{index}]")

    def whole(self, key: str, default: int | None = None, least: int = 0, most: int = MOST) -> int:
        """A whole number."""
        return self._whole(key, self.value[key] if key in self else default, least, most)

    def wholes(self, key: str) -> list[int]:
        """A list of whole numbers; an empty one if it is missing."""
        return [self._whole(f"{key}[{i}]", value, 0, MOST) for i, value in enumerate(self.items(key))]

    def _whole(self, key: str, value: Any, least: int, most: int) -> int:
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if type(value) is not int or not least <= value <= most:
            words = "a whole number, 0 or more" if most == MOST else f"a whole number from {least} to {most}"
            raise self.fail(key, words, *(() if value is None else (value,)))
        return value

    def numbers(self, key: str, least: int, most: int = 0) -> np.ndarray:
        """A list of at least `least` and at most `most` finite numbers, or of just so many, as [n] f64."""
        value = self.value.get(key)
        numbers = [_finite(item) for item in value] if isinstance(value, list) else []
        if None in numbers or not least <= len(numbers) <= max(least, most):
            raise self.fail(key, f"{least} finite numbers" if most <= least else f"{least} to {most} finite numbers")
        return np.array(numbers, np.float64)

    def number(self, key: str) -> float:
        """A finite number."""
        number = _finite(self.value.get(key))
        if number is None:
            raise self.fail(key, "a finite number")
        return number

    def text(self, key: str, default: str | None = None) -> str:
        """A string."""
        value = self.value[key] if key in self else default
        if not isinstance(value, str):
            raise self.fail(key, "a string")
        return value

    def texts(self, key: str) -> list[str]:
        """A list of strings; an empty one if it is missing."""
        values = self.items(key)
        if not all(isinstance(value, str) for value in values):
            raise self.fail(key, "a list of strings")
        return values

    def names(self, key: str, count: int | None = None) -> list[str]:
        """A list of at least `count` file names, without further ones; or a whole list."""
        value = self.value.get(key)
        names = value[:count] if isinstance(value, list) else []
        if len(names) < (count or 1) or not all(isinstance(name, str) and name for name in names):
            raise self.fail(key, "a list of file names" if count is None else f"{count} file name{'s' * (count > 1)}")
        return names

    def flag(self, key: str) -> bool:
        """A boolean; false if it is missing."""
        value = self.value.get(key, False)
        if not isinstance(value, bool):
            raise self.fail(key, "true or false")
        return value


def _finite(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        number = float(value)
    except OverflowError:  # a whole number beyond float64
        return None
    return number if math.isfinite(number) else None
