"""Scenes in other projects' formats, in and out, through the converter package gaussforge (extra `[formats]`).

The converter holds whole files and is native code, so it runs in a process of its own: its memory is gone when it ends, what it
prints stays out of ours, and a file that crashes it is an error like any other. Between the two processes goes an INRIA PLY.
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
"""Logits of opacity 0 and 1, which 8-bit formats store and no logit reaches: half of a 8-bit step from either end is 6.2."""


def read_foreign(path: str | os.PathLike[str]) -> SceneSource:
    """Open a `.spz`, `.sog` or `.compressed.ply` scene.

    It is expanded into a temporary PLY of about 248 bytes a Gaussian (in the folder that TMPDIR names), which lives as long
    as the source; the converter holds the whole scene for a moment.

    Raises
    ------
    InputError
        When the converter is not installed or the file cannot be read.
    FormatError
        When the file breaks its format.
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
    """Write a scene as `.spz`, `.sog` or `.compressed.ply`, with that format's own losses.

    Needs a temporary PLY of about 248 bytes a Gaussian beside the file; `.sog` takes about a minute for 100 000 Gaussians
    (it clusters the SH).

    Returns
    -------
    tuple of str
        Notes for the summary.

    Raises
    ------
    InputError
        When the converter is not installed, the file exists and `force` is not set, or the format cannot hold the scene.
    BudgetError
        When the disk is full.
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
    # Beside the target: the last step is a rename, and /tmp may be memory.
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
    """[N] i64: the rows of `source` in the order of the file that `write_foreign` makes; None where the converter sorts."""
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
    """[N] i64: rows along a Morton curve through the scene's box."""
    means = np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(chunk_rows)], axis=1)
    return near_rows(means)


@cache
def _sh_places(format: Format, degree: int) -> np.ndarray:
    """[3 K] i64: where each SH coefficient must be put so that the converter writes it to its place.

    Version 0.6.0 writes the coefficients of `.compressed.ply` red, green, blue by turns, while it and all others read them
    channel by channel. What this version does is found out by one Gaussian with a ramp of coefficients, there and back.
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
    """A source over another one of the same rows."""

    def __init__(self, parent: SceneSource, name: str, origin: np.ndarray) -> None:
        self.parent, self.name, self.origin, self.notes = parent, name, origin, parent.notes
        self.count, self.sh_degree, self.sh_count = parent.count, parent.sh_degree, parent.sh_count


class _WorldSource(_WrappedSource):
    """World positions in float32 whatever the origin, since other formats have no more digits, and unit quaternions.

    The converter does not normalise: `.sog` files of quaternions as 3DGS trains them came out up to 51 degrees wrong.
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
    """An expanded scene; opacities of exactly 0 and 1 get finite logits. `settings` say what the file says about drawing."""

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
