"""Header parts that both container versions share: strict JSON, checks of its values, and the wording of errors."""

from __future__ import annotations

import json
import math
from collections import Counter
from dataclasses import dataclass
from typing import Any, NoReturn

from flexgs_edge.errors import FormatError, InputError, brief
from flexgs_edge.scene.contraction import LARGEST, Contraction

PREAMBLE_BYTES = 36
MAX_COUNT = 2**32 - 1


class HeaderError(ValueError):
    """A header that breaks the format; the message tells what was wanted and what was found."""


@dataclass(frozen=True)
class Section:
    """A part of the file with its own checksum."""

    name: str
    offset: int
    length: int
    ok: bool = True


def canonical_json(value: object) -> bytes:
    """Encode a value as JSON with sorted keys, without spaces, in ASCII, and without NaN or infinity."""
    try:
        text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    except (TypeError, ValueError, RecursionError) as error:
        raise InputError(f"settings: expected JSON values with text keys and finite numbers: {error}") from None
    return text.encode("ascii")


def parse_json(block: bytes) -> object:
    """Decode JSON without repeated keys, NaN or infinity; raises `HeaderError`."""
    try:
        return json.loads(block.decode("ascii"), object_pairs_hook=_unique, parse_constant=_no_constant)
    except HeaderError:
        raise
    except RecursionError:
        raise HeaderError("wanted JSON, got values nested too deep") from None
    except ValueError as error:  # also for bytes beyond ASCII, and for numbers of absurd length
        raise HeaderError(f"wanted JSON in ASCII, got {error}") from None


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    record = dict(pairs)
    if len(record) != len(pairs):
        twice = Counter(key for key, _ in pairs).most_common(1)[0][0]
        raise HeaderError(f"wanted each key once, got {brief(twice)} twice")
    return record


def _no_constant(text: str) -> NoReturn:
    raise HeaderError(f"wanted finite numbers, got {text}")


def checked_integer(name: str, value: object, lowest: int, highest: int) -> int:
    """Check an integer of a header against its bounds; raises `HeaderError`."""
    # bool is a subclass of int, and `true` must not pass as 1.
    if type(value) is not int or not lowest <= value <= highest:
        raise HeaderError(f"{name}: wanted an integer from {lowest} to {highest}, got {shown(value)}")
    return value


def checked_origin(value: object) -> tuple[float, float, float]:
    """Check three finite numbers of a header; raises `HeaderError`."""
    if isinstance(value, list) and len(value) == 3 and all(type(v) is float and math.isfinite(v) for v in value):
        return (value[0], value[1], value[2])
    raise HeaderError(f"origin: wanted three finite numbers with a decimal point, got {shown(value)}")


def checked_contraction(value: object) -> Contraction:
    """Check the contraction of a header; raises `HeaderError`."""
    if isinstance(value, dict) and sorted(value) == ["centre", "radius"] and isinstance(value["centre"], list):
        numbers = [*value["centre"], value["radius"]]
        known = len(numbers) == 4 and all(type(number) is float and abs(number) <= LARGEST for number in numbers)
        if known and value["radius"] >= 1 / LARGEST:
            return Contraction.from_json(value)
    raise HeaderError(
        "contraction: wanted an object with centre (three numbers with a decimal point, within +-2^126) and radius (2^-126 to "
        f"2^126), got {shown(value)}"
    )


def shown(value: object) -> str:
    """A value for an error message, shortened."""
    return "an integer of more than 40 digits" if isinstance(value, int) and abs(value) >= 10**40 else brief(value)


def format_error(path: object, offset: int, message: str) -> FormatError:
    """The error for wrong bytes in a file; all such messages begin with the file and the byte."""
    return FormatError(f"{path}: byte {offset}: {message}")
