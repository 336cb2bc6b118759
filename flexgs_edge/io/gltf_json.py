"""Objects of a glTF's JSON: values of the expected kind, or an error that names the place."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from flexgs_edge.errors import FormatError, brief


def load_record(text: bytes, name: str) -> Record:
    """The object that a JSON text holds.

    Raises `FormatError` if the text is not JSON, or holds no object.
    """
    try:
        return Record(name, "the JSON", json.loads(text))
    except json.JSONDecodeError as error:
        raise FormatError(
            f"{name}: not JSON: {error.msg} in line {error.lineno}, column {error.colno}; is it complete?"
        ) from error
    except (UnicodeDecodeError, RecursionError, ValueError) as error:
        raise FormatError(f"{name}: not JSON: {brief(str(error))}") from error


class Record:
    """One object of the JSON; every method raises `FormatError`.

    `name`: the file, for messages. `place`: the object, for messages, such as `accessors[3]`. `value`: must be an
    object.
    """

    def __init__(self, name: str, place: str, value: Any) -> None:
        self.name, self.place = name, place
        if not isinstance(value, dict):
            raise FormatError(f"{name}: {place}: expected an object, found {brief(value)}")
        self.value: dict[str, Any] = value

    def __contains__(self, key: str) -> bool:
        return self.value.get(key) is not None

    def fail(self, key: str, expected: str, found: object) -> FormatError:
        """Make the error for a wrong value."""
        return FormatError(f"{self.name}: {self.place}: {key}: expected {expected}, found {brief(found)}")

    def inner(self, key: str) -> Record:
        """The object of a key; an empty one if it is missing."""
        return Record(self.name, f"{self.place}.{key}", self.value[key] if key in self else {})

    def items(self, key: str) -> list[Any]:
        """The list of a key; an empty one if it is missing."""
        value = self.value[key] if key in self else []
        if not isinstance(value, list):
            raise self.fail(key, "a list", value)
        return value

    def item(self, key: str, index: int, asker: str) -> Record:
        """One object of the list of a key, which `asker` refers to."""
        values = self.items(key)
        if not 0 <= index < len(values):
            raise FormatError(
                f"{self.name}: {asker}: refers to {key}[{index}], but the file has {len(values)} {key}; is it complete?"
            )
        return Record(self.name, f"{key}[{index}]", values[index])

    def whole(self, key: str, default: int | None = None) -> int:
        """A whole number from 0 to 2^53."""
        value = self.value[key] if key in self else default
        if isinstance(value, float) and value.is_integer():
            value = int(value)
        if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= 2**53:
            raise self.fail(key, "a whole number, 0 or more", value)
        return value

    def wholes(self, key: str) -> list[int]:
        """A list of whole numbers; an empty one if it is missing."""
        numbers = enumerate(self.items(key))
        return [Record(self.name, self.place, {f"{key}[{i}]": value}).whole(f"{key}[{i}]") for i, value in numbers]

    def numbers(self, key: str, default: tuple[float, ...]) -> np.ndarray:
        """As many finite numbers as `default` has, f64."""
        values = self.value[key] if key in self else list(default)
        expected = f"a list of {len(default)} finite numbers"
        if not isinstance(values, list) or len(values) != len(default):
            raise self.fail(key, expected, values)
        for value in values:
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not _is_finite(value):
                raise self.fail(key, expected, value)
        return np.array([float(value) for value in values])

    def text(self, key: str, default: str | None = None) -> str:
        """A string."""
        value = self.value[key] if key in self else default
        if not isinstance(value, str):
            raise self.fail(key, "a string", value)
        return value

    def texts(self, key: str) -> list[str]:
        """A list of strings; an empty one if it is missing."""
        values = self.items(key)
        for value in values:
            if not isinstance(value, str):
                raise self.fail(key, "a list of strings", value)
        return values

    def flag(self, key: str) -> bool:
        """A boolean; false if it is missing."""
        value = self.value.get(key, False)
        if not isinstance(value, bool):
            raise self.fail(key, "true or false", value)
        return value


def _is_finite(value: float) -> bool:
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number beyond float64
        return False
