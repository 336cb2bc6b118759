"""What each kind of value takes in a version 2 file: counted when it is written, so that nobody has to decode it to know."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

COUNT_MOST = 2**53 - 1
"""Bytes and rows at most: what every reader of JSON keeps exactly."""


@dataclass(frozen=True)
class Channels:
    """Bytes of the kinds of `channel_parts`, rounded, and the rows with SH of degree 1 or more, 2 or more, and so on."""

    bytes: tuple[int, ...]
    rows: tuple[int, ...]

    @classmethod
    def of(cls, taken: Mapping[str, float], rows: Sequence[int]) -> Channels:
        """From the bytes of every alphabet by name, as `channel_bytes` gives them, and the rows of every degree from 1 on."""
        parts = channel_parts(len(rows)).values()
        return cls(tuple(round(sum(taken[part] for part in some)) for some in parts), tuple(map(int, rows)))


def channel_parts(sh_degree: int) -> dict[str, tuple[str, ...]]:
    """Kinds of value of version 2, and the alphabets that make them up."""
    parts: dict[str, tuple[str, ...]] = {"position": ("position", "repeats")}
    parts |= {name: tuple(f"{name} {axis}" for axis in "xyz") for name in ("scale", "rotation")}
    parts |= {"opacity": ("opacity",), "dc": ("dc Y", "dc Co", "dc Cg"), "sh degree": ("sh degree",)}
    return parts | {f"sh {d}": tuple(f"sh {d} {c}" for c in ("Y", "Co", "Cg")) for d in range(1, sh_degree + 1)}
