"""The table of other programs' formats: suffixes, frames, readers, writers, and what searches need to know of them."""

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import InputError
from flexgs_edge.io.frames import LUF, RDF, RUB, Frame
from flexgs_edge.io.reading import PLAIN, Reading, Writing


def _as_float32(means: np.ndarray, largest: float) -> np.ndarray:
    """Half a step of float32 at each position."""
    return np.ldexp(0.5, np.frexp(np.abs(means).max(axis=0))[1] - 24)


def _fixed_point(means: np.ndarray, largest: float) -> np.ndarray:
    """Half a step of signed integers of 24 bits: one step for all positions."""
    return np.full(means.shape[1], np.ldexp(0.5, np.frexp(largest)[1] - 23))


def _logarithmic(means: np.ndarray, largest: float) -> np.ndarray:
    """Half a step of 16 bits over the logarithms of both signs: it grows with the distance from zero."""
    return (1 + np.abs(means).max(axis=0)) * (np.log1p(largest) / 65535)


@dataclass(frozen=True)
class Format:
    """A format. `row_bytes`, `sh_bytes`: Bytes of a fixed row of SH degree 3, and of SH among them."""

    suffix: str  # End of file names, with its dot; or a whole file name
    # `module:function` of `read(path, name, reading)`, which returns a source in the file's frame. `name` is the
    # user's path. Imported only when a file needs it, so start-up stays fast.
    reader: str
    # `module:function` of `write(file, source, writing)`, which writes a source in the file's frame to an open binary
    # file. `None`: only read.
    writer: str | None = None
    frame: Frame = RDF  # Directions of the axes in files of this format
    reach: float = float("inf")  # Largest coordinate that it holds, scene units
    # From positions [3, n] f64 and the largest coordinate of the scene to the largest errors [n] f64 of a coordinate, at least
    position_error: Callable[[np.ndarray, float], np.ndarray] = _as_float32
    keeps_origin: bool = False  # It holds the origin of a scene far from zero apart, in float64
    max_degree: int = 3  # Highest SH degree
    fixed_rows: bool = False  # All rows take the same bytes: neither coarser values nor SH of zero save any
    chunked: bool = False  # Neighbours in the file share ranges that round their positions
    row_bytes: float = 0.0
    sh_bytes: float = 0.0
    most_colour: float = float("inf")  # Largest SH coefficient of degree 0 that it holds, on both sides of zero
    memory: int = 512  # Most bytes a Gaussian that writing and reading back hold
    marks_antialiased: bool = False  # Whether its files can say that a model is antialiased
    # A module that reading and writing load, and the extra of this package that brings it; or nothing
    needs: tuple[str, ...] = ()

    def read(self, path: Path, name: str, reading: Reading) -> Any:
        """Call the reader."""
        self.check_needs(name)
        return _function(self.reader)(path, name, reading)

    def write(self, *arguments: Any) -> None:
        """Call the writer."""
        assert self.writer is not None
        _function(self.writer)(*arguments)

    def check_needs(self, name: object) -> None:
        """Raise `InputError` if an extra is missing that this format needs."""
        if self.needs and find_spec(self.needs[0]) is None:
            raise InputError(f"{name}: {self.suffix} files need pip install 'flexgs-edge[{self.needs[1]}]'")

    @property
    def word(self) -> str:
        """The format in records: its suffix without the dot."""
        return self.suffix.lstrip(".")


def _function(place: str) -> Callable[..., Any]:
    module, _, name = place.partition(":")
    return getattr(import_module(module), name)


_IO = "flexgs_edge.io"
FORMATS: dict[str, Format] = {
    format.suffix: format
    for format in (
        Format(
            ".spz", f"{_IO}.spz:read_spz", f"{_IO}.spz_writer:write_spz", RUB, reach=2.0**23 - 1,
            position_error=_fixed_point, max_degree=4, marks_antialiased=True,
        ),
        Format(
            ".sog", f"{_IO}.sog:read_sog", f"{_IO}.sog_writer:write_sog",
            position_error=_logarithmic, memory=1024, marks_antialiased=True,
        ),
        Format("lod-meta.json", f"{_IO}.streamed_sog:read_streamed_sog"),
        Format("meta.json", f"{_IO}.sog:read_sog_folder"),
        # 16 bytes, 45 bytes of SH, and 72 bytes for each chunk of 256 rows.
        Format(
            ".compressed.ply", f"{_IO}.compressed_ply:read_compressed_ply", f"{_IO}.compressed_ply:write_compressed_ply",
            fixed_rows=True, chunked=True, row_bytes=61.3, sh_bytes=45.0,
        ),
        Format(
            ".splat", f"{_IO}.splat:read_splat", f"{_IO}.splat:write_splat",
            max_degree=0, fixed_rows=True, row_bytes=32.0, sh_bytes=0.0, most_colour=0.5 / SH_C0,
        ),
        Format(".ksplat", f"{_IO}.ksplat:read_ksplat"),
        Format(
            ".glb", f"{_IO}.gltf:read_gltf", f"{_IO}.glb_writer:write_glb", LUF,
            keeps_origin=True, fixed_rows=True, row_bytes=232.0, sh_bytes=180.0, memory=1024,
        ),
        Format(".gltf", f"{_IO}.gltf:read_gltf", frame=LUF),
        *(
            Format(
                f".{word}", f"{_IO}.usd:read_usd", f"{_IO}.usd:write_{word}", RUB, keeps_origin=True, max_degree=4,
                fixed_rows=True, row_bytes=224.0, sh_bytes=180.0, memory=memory, needs=("pxr", "usd"),
            )
            for word, memory in (("usd", 3072), ("usda", 10240), ("usdc", 3072), ("usdz", 3072))
        ),
    )
}  # fmt: skip
_GLB_SPZ = replace(
    FORMATS[".glb"], writer=f"{_IO}.glb_writer:write_glb_spz", reach=FORMATS[".spz"].reach, position_error=_fixed_point,
    fixed_rows=False, marks_antialiased=True,
)  # fmt: skip
WRITTEN: tuple[str, ...] = tuple(suffix for suffix, format in FORMATS.items() if format.writer)
"""Suffixes that can be written."""


def format_of(path: str | os.PathLike[str]) -> Format | None:
    """The format of a file name, or None."""
    name = Path(path).name.lower()
    return next((format for suffix, format in FORMATS.items() if name.endswith(suffix)), None)


def written_format(path: str | os.PathLike[str], writing: Writing = PLAIN) -> Format | None:
    """The format that a file of this name is written in, or None; raises `InputError` for formats that are only read."""
    format = format_of(path)
    if format is not None and format.writer is None:
        raise InputError(f"-o {path}: {format.suffix} files are only read; write one of {', '.join(WRITTEN)}")
    if format is not None:
        format.check_needs(path)
    return _GLB_SPZ if format is FORMATS[".glb"] and writing.glb == "spz" else format
