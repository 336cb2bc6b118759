"""The table of other programs' formats, and the choice of a format by file name."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

from flexgs_edge.errors import InputError


@dataclass(frozen=True)
class Format:
    """A format of the converter.

    Parameters
    ----------
    suffix : str
        End of file names, with its dot.
    name : str
        The converter's name of the format.
    reach : float
        Largest coordinate that it holds, scene units.
    max_degree : int
        Highest SH degree.
    sorted : bool
        Rows must come in an order in which neighbours are near each other: 256 rows share a range, and the converter
        does not sort. Unsorted positions would be several times worse.
    shuffled : bool
        The converter sorts rows by itself.
    probed : bool
        The converter may write SH in another order than it reads them (see `_sh_places`).
    finer_sh : bool
        We write the SH again with a finer step than the converter's (see `flexgs_edge.io.spz`).
    one_degree : bool
        Only a lower SH degree of the whole scene saves bytes; SH that are zero take as much as others.
    row_bytes : float
        Approximate bytes of a Gaussian of SH degree 3, where searches start.
    sh_bytes : float
        Bytes of SH among them.
    memory : int
        Most bytes a Gaussian that the converter holds.
    """

    suffix: str
    name: str
    reach: float = float("inf")
    max_degree: int = 3
    sorted: bool = False
    shuffled: bool = False
    probed: bool = False
    finer_sh: bool = False
    one_degree: bool = False
    row_bytes: float = 20.0
    sh_bytes: float = 5.0
    memory: int = 1024


FORMATS: dict[str, Format] = {
    format.suffix: format
    for format in (
        # Positions are 24-bit numbers with 12 bits behind the point.
        Format(".spz", "spz", reach=2.0**11 - 2.0**-12, finer_sh=True, row_bytes=22.0, sh_bytes=5.5),
        Format(".sog", "sog", shuffled=True, row_bytes=39.7, sh_bytes=27.4, memory=2048),
        # 16 bytes, 45 bytes of SH, and 72 bytes for each chunk of 256 rows.
        Format(
            ".compressed.ply",
            "compressed.ply",
            sorted=True,
            probed=True,
            one_degree=True,
            row_bytes=61.3,
            sh_bytes=45.0,
        ),
    )
}


def format_of(path: str | os.PathLike[str]) -> Format | None:
    """The format of a file name, or None."""
    name = Path(path).name.lower()
    return next((format for suffix, format in FORMATS.items() if name.endswith(suffix)), None)


def required_format(path: str | os.PathLike[str]) -> Format:
    """The format of a file name; raises `InputError` if there is none."""
    format = format_of(path)
    if format is None:
        raise InputError(f"{path}: expected a file ending in {', '.join(FORMATS)}")
    return format
