"""Bytes of each kind of value in a version 2 file.

The header stores them, so that `info` need not decode the chunks.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

COUNT_MOST = 2**53 - 1
"""Largest number of bytes or rows: every JSON reader keeps integers up to here exactly."""


@dataclass(frozen=True)
class Channels:
    """Bytes of each kind in `channel_parts`, rounded, and the number of rows with SH of at least degree 1, 2 and so on."""

    bytes: tuple[int, ...]
    rows: tuple[int, ...]

    @classmethod
    def of(cls, taken: Mapping[str, float], rows: Sequence[int]) -> Channels:
        """Make the record from the bytes of each alphabet (as in `channel_bytes`) and the rows of each degree from 1 on."""
        parts = channel_parts(len(rows)).values()
        return cls(tuple(round(sum(taken[part] for part in some)) for some in parts), tuple(map(int, rows)))


def channel_parts(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """The kinds of value in version 2, and the alphabets of each."""
    parts: dict[str, tuple[str, ...]] = {"position": ("position", "repeats")}
    parts |= {name: tuple(f"{name} {axis}" for axis in "xyz") for name in ("scale", "rotation")}
    parts |= {"opacity": ("opacity",), "dc": ("dc Y", "dc Co", "dc Cg"), "sh degree": ("sh degree",)}
    return parts | {f"sh {d}": tuple(f"sh {d} {c}" for c in ("Y", "Co", "Cg")) for d in range(1, sh_degree + 1)}
