"""Read and write scenes in formats of other projects, in the frame and the row order of each format."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_folder, atomic_write, check_readable
from flexgs_edge.io.formats import FORMATS, Format, format_of, written_format
from flexgs_edge.io.frames import in_frame
from flexgs_edge.io.reading import AS_WRITTEN, PLAIN, Reading, Writing
from flexgs_edge.io.streamed_sog_writer import write_streamed_sog
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.lower_sh import without_degrees
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import Planes, Rows, SceneSource

_FAR = 16.0
"""Rows further than so many median distances from the median centre are far."""


def read_foreign(
    path: str | os.PathLike[str], reading: Reading = AS_WRITTEN, name: str | None = None, format: Format | None = None
) -> SceneSource:
    """Open a scene in another program's format, with its axes in RDF.

    Parameters
    ----------
    path : path
        The file that is read.
    reading : Reading, optional
        Frame and level that the user asks for.
    name : str, optional
        The path for messages. Default: `path`.
    format : Format, optional
        Default: as the file name says.

    Raises
    ------
    InputError
        If the file cannot be read.
    FormatError
        If the file breaks its format.
    """
    name = os.fspath(path) if name is None else name
    format = format or format_of(path)
    assert format is not None
    check_readable(path, name)
    try:
        source: SceneSource = format.read(Path(path), name, reading)
    except OSError as error:
        raise InputError(f"{name}: cannot read the scene ({error.strerror})") from error
    return in_frame(source, reading.frame or getattr(source, "frame", None) or format.frame)


def write_foreign(
    path: str | os.PathLike[str], source: SceneSource, *, force: bool = False, writing: Writing = PLAIN
) -> tuple[str, ...]:
    """Write a scene in another program's format, with the losses of that format.

    Rows are written along a space-filling curve (`near_order`), because neighbours share ranges and compress together.

    Returns
    -------
    tuple of str
        Notes for the summary.

    Raises
    ------
    InputError
        If the file exists and `force` is not set, or the format cannot hold the scene.
    BudgetError
        If the disk is full.
    """
    format = written_format(path)
    assert format is not None
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: nothing to write to {path}")
    world = _WorldSource(without_degrees(source, format.max_degree), keep_origin=format.digits is None)
    _check_reach(path, world, format)
    if not writing.force_lossy:
        _check_digits(path, source, format)
    with atomic_write(path, force) as file:
        format.write(file, in_frame(world.select(near_order(source)), format.frame), writing)
    return _notes(source, format)


def write_streamed(
    folder: str | os.PathLike[str],
    source: SceneSource,
    layers: Sequence[int],
    *,
    preview: SceneSource | None = None,
    force: bool = False,
    writing: Writing = PLAIN,
) -> tuple[str, ...]:
    """Write a scene as streamed SOG; `layers` counts the rows of each layer, in their order. Otherwise as `write_foreign`.

    A preview is the coarsest level.
    """
    format = FORMATS[".sog"]
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: nothing to write to {folder}")
    world = _WorldSource(without_degrees(source, format.max_degree))
    if not writing.force_lossy:
        _check_digits(folder, source, format)
    with atomic_folder(folder, force) as place:
        small = None if preview is None else in_frame(_WorldSource(preview), format.frame)
        write_streamed_sog(place, in_frame(world, format.frame), layers, writing, small)
    return _notes(source, format)


def _notes(source: SceneSource, format: Format) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    if source.sh_degree > format.max_degree:
        notes = (f"SH above degree {format.max_degree} left out: {format.suffix} holds no others",)
    if np.any(source.origin != 0) and format.digits is not None:
        notes += ("positions rounded to float32: the scene is far from zero",)
    return notes


def written_order(source: SceneSource) -> np.ndarray:
    """[N] i64, rows of `source` in the order that `write_foreign` writes them."""
    return near_order(source)


def near_order(source: SceneSource, chunk_rows: int = 65536) -> np.ndarray:
    """[N] i64, the rows along a Morton curve through the box of the scene, far ones last, by octaves of their distance.

    Formats whose chunks share a range would else lose the digits of near rows to far ones beside them.
    """
    means = np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(chunk_rows)], axis=1)
    order = near_rows(means)
    away = means - np.median(means, axis=1, keepdims=True).astype(np.float64)
    distances = np.sqrt((away * away).sum(axis=0))
    limit = _FAR * float(np.median(distances))
    if not 0 < limit < np.max(distances):
        return order
    octaves = np.maximum(np.frexp(distances / limit)[1], 0)
    found: np.ndarray = order[np.argsort(octaves[order], kind="stable")]
    return found


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


def _check_digits(path: str | os.PathLike[str], source: SceneSource, format: Format, chunk_rows: int = 65536) -> None:
    """Refuse a scene far from zero whose positions the format cannot hold to a tenth of the smallest splat."""
    if format.digits is None or not np.any(source.origin):
        return
    largest, smallest = 0.0, np.inf
    for rows in source.chunks(chunk_rows):
        planes = source.read(rows, ["means", "log_scales"])
        largest = max(largest, float(np.max(np.abs(planes["means"] + source.origin[:, None]))))
        smallest = min(smallest, float(np.exp(np.max(planes["log_scales"].astype(np.float64), axis=0)).min()))
    error = float(np.ldexp(0.5, int(np.frexp(largest)[1]) - format.digits))
    if error > smallest / 10:
        raise InputError(
            f"{path}: {format.suffix} holds coordinates of {largest:.0f} only to {error:.2g}, and the smallest splat of "
            f"{source.name} measures {smallest:.2g}: write a .glb or a .ply, move the scene to zero first, or use "
            "decompress --force-lossy"
        )


class _WorldSource(SceneSource):
    """A scene as writers need it: world positions in float32, and unit quaternions.

    Most formats have no digits for an origin, and can only hold unit quaternions.
    """

    def __init__(self, parent: SceneSource, keep_origin: bool = False) -> None:
        self.parent, self.name, self.notes = parent, parent.name, parent.notes
        self.origin = parent.origin if keep_origin else np.zeros(3)
        self.moved = bool(np.any(parent.origin != self.origin))
        self.count, self.sh_degree, self.sh_count = parent.count, parent.sh_degree, parent.sh_count
        self.settings, self.held_bytes, self.valid = parent.settings, parent.held_bytes, parent.valid

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        planes = self.parent.read(rows, fields, out)
        if "quats" in planes:
            planes["quats"][...] = normalize_quats(planes["quats"])
        if "means" in planes and self.moved:
            planes["means"][...] = planes["means"].astype(np.float64) + self.parent.origin[:, None]
        return planes
