"""What the headers of both container versions share: the preamble, strict JSON and its checks."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Any, NoReturn

from flexgs_edge.errors import FormatError, InputError, brief

PREAMBLE_BYTES = 36
MAX_COUNT = 2**32 - 1


class HeaderError(ValueError):
    """A header that breaks the format: what was wanted and what was found."""


@dataclass(frozen=True)
class Section:
    """A part of the file that has a checksum of its own."""

    name: str
    offset: int
    length: int
    ok: bool = True


def canonical_json(value: object) -> bytes:
    """JSON with sorted keys, no spaces, ASCII only, and no NaN or infinity."""
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"settings: expected JSON values with text keys and finite numbers: {error}") from None
    return text.encode("ascii")


def parse_json(block: bytes) -> object:
    """JSON without repeated keys, NaN or infinity."""
    try:
        return json.loads(block.decode("ascii"), object_pairs_hook=_unique, parse_constant=_no_constant)
    except HeaderError:
        raise
    except RecursionError:
        raise HeaderError("wanted JSON, got values nested too deep") from None
    except ValueError as error:  # also bytes that are not ASCII, and numbers of absurd length
        raise HeaderError(f"wanted JSON in ASCII, got {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) != len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise HeaderError(f"wanted each key once, got {twice!r} twice")
    return record


def _no_constant(text: str) -> NoReturn:
    raise HeaderError(f"wanted finite numbers, got {text}")


def checked_integer(name: str, value: object, lowest: int, highest: int) -> int:
    """An integer from a header, within bounds; raises `HeaderError`."""
    # bool is a subclass of int: true is not 1 here.
    if type(value) is not int or not lowest <= value <= highest:
        raise HeaderError(f"{name}: wanted an integer from {lowest} to {highest}, got {shown(value)}")
    return value


def checked_origin(value: object) -> tuple[float, float, float]:
    """Three finite numbers from a header; raises `HeaderError`."""
    if isinstance(value, list) and len(value) == 3 and all(type(v) is float and math.isfinite(v) for v in value):
        return (value[0], value[1], value[2])
    raise HeaderError(f"origin: wanted three finite numbers with a decimal point, got {shown(value)}")


def shown(value: object) -> str:
    """A value in an error text: short, however long it is."""
    return "an integer of more than 40 digits" if isinstance(value, int) and abs(value) >= 10**40 else brief(value)


def format_error(path: object, offset: int, message: str) -> FormatError:
    """The one wording of all errors about a file's bytes."""
    return FormatError(f"{path}: byte {offset}: {message}")
