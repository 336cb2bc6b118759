"""Read and write sizes in bytes with units, such as `8MB` and `1.5 GiB`."""

import re

from flexgs_edge.errors import InputError

_UNITS = {"": 1, "B": 1, "KB": 10**3, "MB": 10**6, "GB": 10**9, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}


def parse_size(text: str) -> int:
    """Bytes of a size such as `1.5MB` (10^6), `512MiB` (2^20) or `700`.

    >>> parse_size("1.5MB"), parse_size("512MiB"), parse_size("700")
    (1500000, 536870912, 700)
    """
    match = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?|\.[0-9]+)\s*([A-Za-z]*)\s*", text)
    unit = match.group(2).upper() if match else None
    if match is None or unit not in _UNITS:
        raise InputError(f"size {text!r}: expected a number and a unit such as 700, 1.5MB or 512MiB")
    return int(float(match.group(1)) * _UNITS[unit])


def format_size(size: int) -> str:
    """A size for people, in powers of ten: `1.50 MB`.

    >>> format_size(1500000)
    '1.50 MB'
    """
    unit, scale = unit_of(size)
    return f"{size} B" if scale == 1 else f"{size / scale:.2f} {unit}"


def unit_of(size: float) -> tuple[str, int]:
    """The largest unit, a power of ten, that is not larger than a size; and its bytes."""
    return next((each for each in (("GB", 10**9), ("MB", 10**6), ("kB", 10**3)) if size >= each[1]), ("bytes", 1))


def format_mib(size: int) -> str:
    """A memory limit for people, rounded up to whole MiB: `512MiB`. `parse_size` reads it back."""
    return f"{-(-size // 2**20)}MiB"


def smaller_words(size: int, of: int) -> str:
    """How much smaller or larger `size` bytes are than `of` bytes, in percent.

    >>> smaller_words(250, 1000), smaller_words(1423, 1000)
    ('75.0 % smaller', '42.3 % larger')
    """
    share = 100.0 * (1.0 - size / of)
    return f"{share:.1f} % smaller" if share >= 0 else f"{-share:.1f} % larger"


def times_words(ratio: float, digits: int = 2) -> str:
    """How many times smaller or larger a file is that goes `ratio` times into another.

    >>> times_words(4.0), times_words(1 / 3, 1)
    ('4.00 times smaller', '3.0 times larger')
    """
    return f"{ratio:.{digits}f} times smaller" if ratio >= 1 else f"{1 / ratio:.{digits}f} times larger"
