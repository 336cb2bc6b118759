"""Check values of JSON camera files; error messages name the file, the entry and the key."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.files import parse_json

ROTATION_TOLERANCE = 1e-3
"""Largest entry of |R R^T - 1|. Files keep 6 digits or more; a scaled or sheared matrix is off by far more."""
MAX_SIDE = 65535  # Most pixels of a side; a larger number means a damaged file (JPEG has this limit too)
_SHOWN = 20  # Most keys in a message


def load_json(path: Path, what: str = "the cameras") -> Any:
    """Load the value of a JSON file, which messages call `what`.

    Raises `InputError` if the file cannot be read. Raises `FormatError` if it is not JSON.
    """
    try:
        text = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot read {what} ({error.strerror})") from error
    return parse_json(text, path)


def kind(value: Any) -> str:
    """The type of a JSON value, in words for messages."""
    names = {dict: "an object", list: "a list", str: "a string", bool: "a boolean", type(None): "null"}
    return names.get(type(value), "a number")


class Entry:
    """One object of a file, with its place for messages; every method raises `FormatError`.

    `place`: such as "cameras.json: camera 3". `entry`: must be an object.
    """

    def __init__(self, place: str, entry: Any) -> None:
        self.place = place
        if not isinstance(entry, dict):
            raise FormatError(f"{self.place}: expected an object, found {kind(entry)}")
        self.entry = entry

    def has(self, key: str) -> bool:
        """Whether the key exists and its value is not null."""
        return self.entry.get(key) is not None

    def get(self, key: str) -> Any:
        """The value of a key, of any type."""
        if key not in self.entry:
            found = ", ".join(map(brief, list(self.entry)[:_SHOWN])) + (", ..." if len(self.entry) > _SHOWN else "")
            raise FormatError(f"{self.place}: missing key {key!r}; found {found or 'none'}")
        return self.entry[key]

    def fail(self, key: str, expected: str, found: str) -> FormatError:
        """Make the error for a wrong value."""
        return FormatError(f"{self.place}: {key}: expected {expected}, found {found}")

    def name(self, key: str) -> str:
        """A string that is not blank."""
        name = self.get(key)
        if not isinstance(name, str) or not name.strip():
            raise self.fail(key, "a name", brief(name))
        return name

    def number(self, key: str, expected: str) -> float:
        """Any number, including NaN and infinities."""
        value = self.get(key)
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise self.fail(key, expected, kind(value))
        try:
            return float(value)
        except OverflowError:
            raise self.fail(key, expected, "a number beyond float64") from None

    def finite(self, key: str, expected: str) -> float:
        """A finite number."""
        value = self.number(key, expected)
        if not math.isfinite(value):
            raise self.fail(key, expected, f"{value:g}")
        return value

    def side(self, key: str) -> int:
        """Width or height in pixels."""
        expected = f"a whole number of pixels from 1 to {MAX_SIDE}"
        value = self.number(key, expected)
        if not 1 <= value <= MAX_SIDE or value != int(value):
            raise self.fail(key, expected, f"{value:g}")
        return int(value)

    def focal(self, key: str) -> float:
        """A focal length in pixels."""
        expected = "a focal length above 0 pixels"
        value = self.finite(key, expected)
        if value <= 0:
            raise self.fail(key, expected, f"{value:g}")
        return value

    def array(self, key: str, shape: tuple[int, ...]) -> np.ndarray:
        """Nested lists of finite numbers as an array ([*shape] f64)."""
        expected = " x ".join(map(str, shape)) + " finite numbers"
        value = self.get(key)
        if _shape(value, len(shape)) != shape:
            raise self.fail(key, expected, brief(value))
        leaves = np.array(value, dtype=object)
        if not all(isinstance(leaf, (int, float)) and not isinstance(leaf, bool) for leaf in leaves.flat):
            raise self.fail(key, expected, brief(value))
        try:
            array = leaves.astype(np.float64)
        except OverflowError:
            raise self.fail(key, expected, "a number beyond float64") from None
        if not np.all(np.isfinite(array)):
            raise self.fail(key, expected, f"{array.tolist()}")
        return array

    def check_rotation(self, key: str, rotation: np.ndarray) -> None:
        """Raise unless `rotation` ([3, 3]) is orthonormal (to the digits that files keep) and no reflection."""
        with np.errstate(over="ignore", invalid="ignore"):  # entries such as 1e200 fail the check, whatever comes out
            error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
        if not error <= ROTATION_TOLERANCE:
            raise self.fail(key, f"an orthonormal matrix (within {ROTATION_TOLERANCE})", f"one off by {error:.3g}")
        if np.linalg.det(rotation) < 0:
            raise self.fail(key, "a rotation (determinant 1)", "a reflection (determinant -1)")


def _shape(value: Any, depth: int) -> tuple[int, ...] | None:
    """Shape of lists nested `depth` levels deep; None if they are deeper or ragged, which NumPy would raise on."""
    if not isinstance(value, list):
        return ()
    if not depth:
        return None
    shapes = {_shape(item, depth - 1) for item in value}
    inner = shapes.pop() if len(shapes) == 1 else None
    return None if inner is None else (len(value), *inner)
