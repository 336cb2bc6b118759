"""Read and write scenes in formats of other projects, through the converter package gaussforge (extra `[formats]`).

The converter is native code and holds whole files, so it runs in a process of its own. The end of that process frees
its memory, its output stays out of ours, and a crash becomes an ordinary error. The processes exchange an INRIA PLY.
"""

from __future__ import annotations

import os
import tempfile
import weakref
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np

from flexgs_edge.errors import FlexGSError, FormatError, InputError
from flexgs_edge.files import check_writable
from flexgs_edge.io.converter import CONVERTER, check_converter, convert
from flexgs_edge.io.formats import Format, required_format
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.io.spz import is_antialiased, refine_sh
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import MemorySource, Planes, Rows, SceneSource

OPACITY_LIMIT = 7.0
"""Logits for opacities 0 and 1. 8-bit formats store these, but logits do not reach them; half a step from the end is
6.2."""


def read_foreign(path: str | os.PathLike[str]) -> SceneSource:
    """Open a `.spz`, `.sog` or `.compressed.ply` scene.

    The file is expanded into a temporary PLY of about 248 bytes a Gaussian, in the folder that TMPDIR names. The PLY
    lives as long as the source. During expansion, the converter holds the whole scene in memory.

    Raises
    ------
    InputError
        If the converter is not installed, or the file cannot be read.
    FormatError
        If the file breaks its format.
    """
    format = required_format(path)
    check_converter(path)
    if not Path(path).is_file():
        raise InputError(f"{path}: no such scene file")
    folder = tempfile.TemporaryDirectory(prefix="flexgs-")
    try:
        expanded = Path(folder.name) / "scene.ply"
        convert(path, Path(path), format.name, expanded, "ply")
        return _ForeignSource(path, expanded, folder, format)
    except BaseException:
        folder.cleanup()
        raise


def write_foreign(path: str | os.PathLike[str], source: SceneSource, *, force: bool = False) -> tuple[str, ...]:
    """Write a scene as `.spz`, `.sog` or `.compressed.ply`, with the losses of that format.

    This needs a temporary PLY of about 248 bytes a Gaussian beside the file. `.sog` clusters the SH, which takes about
    a minute for 100 000 Gaussians.

    Returns
    -------
    tuple of str
        Notes for the summary.

    Raises
    ------
    InputError
        If the converter is not installed, the file exists and `force` is not set, or the format cannot hold the scene.
    BudgetError
        If the disk is full.
    """
    format = required_format(path)
    check_converter(path)
    target = check_writable(path, force)
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: nothing to write to {path}")
    if source.sh_degree > format.max_degree:
        raise InputError(
            f"{path}: {format.suffix} holds SH up to degree {format.max_degree}, this scene has {source.sh_degree}; write a .ply"
        )
    world = _WorldSource(source)
    _check_reach(path, world, format)
    # Beside the target, since the last step is a rename, and /tmp may lie in memory.
    with tempfile.TemporaryDirectory(prefix=".flexgs-", dir=target.parent) as folder:
        plain, finished = Path(folder) / "scene.ply", Path(folder) / f"scene{format.suffix}"
        if format.probed and source.sh_degree:
            world.sh_places = _sh_places(format, source.sh_degree)
        write_ply(plain, world.select(near_order(world)) if format.sorted else world)
        convert(path, plain, "ply", finished, format.name)
        if format.finer_sh and source.sh_degree:
            coded = finished.rename(Path(folder) / "coded")
            refine_sh(coded, world, finished)
        os.replace(finished, target)
    far = bool(np.any(source.origin != 0))
    return ("positions rounded to float32: the scene is far from zero",) if far else ()


def written_order(source: SceneSource, format: Format) -> np.ndarray | None:
    """[N] i64, rows of `source` in the order that `write_foreign` writes them.

    It is None if the converter sorts by itself.
    """
    if format.shuffled:
        return None
    return near_order(_WorldSource(source)) if format.sorted else np.arange(source.count)


def _check_reach(path: str | os.PathLike[str], source: SceneSource, format: Format, chunk_rows: int = 65536) -> None:
    if np.isinf(format.reach):
        return
    for rows in source.chunks(chunk_rows):
        means = source.read(rows, ["means"])["means"]
        far = np.flatnonzero(~(np.abs(means) <= format.reach).all(axis=0))
        if far.size:
            raise InputError(
                f"{path}: {format.suffix} holds coordinates up to {format.reach:.0f}; row {rows.start + far[0]} of {source.name} "
                f"lies at {', '.join(f'{v:g}' for v in means[:, far[0]])}: write a .ply, or move the scene to zero first"
            )


def near_order(source: SceneSource, chunk_rows: int = 65536) -> np.ndarray:
    """[N] i64, the rows along a Morton curve through the box of the scene."""
    means = np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(chunk_rows)], axis=1)
    return near_rows(means)


@cache
def _sh_places(format: Format, degree: int) -> np.ndarray:
    """[3 K] i64, the place where each SH coefficient must stand so that the converter writes it to its right place.

    Version 0.6.0 writes SH of `.compressed.ply` with red, green, blue by turns, but all versions read them channel by
    channel. To find out, we convert one Gaussian with a ramp of coefficients there and back.
    """
    width = FIELD["sh_rest"].width(degree)
    planes = {field.name: np.zeros((field.width(degree), 1), np.float32) for field in FIELDS}
    planes["sh_rest"][:, 0] = np.linspace(-2, 2, width)
    planes["quats"][0] = 1
    with tempfile.TemporaryDirectory(prefix="flexgs-") as folder:
        plain, coded, back = (Path(folder) / name for name in ("scene.ply", f"scene{format.suffix}", "back.ply"))
        write_ply(plain, MemorySource(planes, degree))
        convert(coded, plain, "ply", coded, format.name)
        convert(coded, coded, format.name, back, "ply")
        found = PlySource(back).read(slice(0, 1), ["sh_rest"])["sh_rest"][:, 0]
    places = np.rint((found + 2) / 4 * (width - 1)).astype(np.int64)
    if sorted(places.tolist()) != list(range(width)):
        raise InputError(
            f"this version of {CONVERTER} does not keep SH in {format.suffix}; update it or write another format"
        )
    return places


class _WrappedSource(SceneSource):
    """A source over another one, with the same rows."""

    def __init__(self, parent: SceneSource, name: str, origin: np.ndarray) -> None:
        self.parent, self.name, self.origin, self.notes = parent, name, origin, parent.notes
        self.count, self.sh_degree, self.sh_count = parent.count, parent.sh_degree, parent.sh_count


class _WorldSource(_WrappedSource):
    """A scene as the converter needs it: world positions in float32, and unit quaternions.

    The other formats have no digits for an origin. The converter does not normalise quaternions, and `.sog` files would
    get wrong rotations.
    """

    def __init__(self, parent: SceneSource) -> None:
        super().__init__(parent, parent.name, np.zeros(3))
        self.sh_places: np.ndarray | None = None

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        planes = self.parent.read(rows, fields, out)
        if "sh_rest" in planes and self.sh_places is not None:
            planes["sh_rest"][self.sh_places] = planes["sh_rest"].copy()
        if "quats" in planes:
            planes["quats"][...] = normalize_quats(planes["quats"])
        if "means" in planes and np.any(self.parent.origin != 0):
            planes["means"][...] = planes["means"].astype(np.float64) + self.parent.origin[:, None]
        return planes


class _ForeignSource(_WrappedSource):
    """A scene expanded to a PLY.

    Opacities of exactly 0 and 1 get finite logits; `settings` hold the file's way of drawing.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        expanded: Path,
        folder: tempfile.TemporaryDirectory[str],
        format: Format,
    ) -> None:
        try:
            parent = PlySource(expanded)
        except FlexGSError as error:
            raise FormatError(f"{path}: not a Gaussian scene as {CONVERTER} reads it: {error}") from error
        super().__init__(parent, os.fspath(path), parent.origin)
        self.format = format
        self.settings = {"antialiased": True} if format.name == "spz" and is_antialiased(path) else {}
        weakref.finalize(self, folder.cleanup)

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        planes = self.parent.read(rows, fields, out)
        if "opacity_logits" in planes:
            logits = planes["opacity_logits"]
            logits[logits == np.inf] = OPACITY_LIMIT
            logits[logits == -np.inf] = -OPACITY_LIMIT
        return planes
