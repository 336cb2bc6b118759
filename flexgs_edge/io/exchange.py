"""Read and write scenes in formats of other projects, in the frame and the row order of each format."""

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_folder, atomic_write, check_readable
from flexgs_edge.io.codes import opacities
from flexgs_edge.io.compressed_ply import CHUNK, chunk_order
from flexgs_edge.io.formats import FORMATS, Format, format_of, written_format
from flexgs_edge.io.frames import in_frame
from flexgs_edge.io.reading import AS_WRITTEN, PLAIN, Reading, Writing
from flexgs_edge.io.streamed_sog_writer import STREAMED, write_streamed_sog
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import Planes, SceneSource, WrappedSource, without_degrees

_FINER = 10.0  # A scene is too far from zero for a format if its positions would be so many times finer at zero
_FAR = 16.0  # Rows further than so many median distances from the median centre are far


def read_foreign(
    path: str | os.PathLike[str], reading: Reading = AS_WRITTEN, name: str | None = None, format: Format | None = None
) -> SceneSource:
    """Open a scene in another program's format, with its axes in RDF.

    `reading`: frame and level that the user asks for. `name`: the path for messages. Default: `path`. `format`: by default,
    as the file name says. Raises `InputError` if the file cannot be read. Raises `FormatError` if it breaks its format.
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
    Returns notes for the summary. Raises `InputError` if the file exists and `force` is not set, or the format cannot hold
    the scene. Raises `BudgetError` if the disk is full.
    """
    format = written_format(path, writing)
    assert format is not None
    if source.count == 0:
        raise InputError(f"{source.name}: the scene is empty: nothing to write to {path}")
    check_positions(source, format, writing.force_lossy)
    world = _WorldSource(without_degrees(source, format.max_degree), format.keeps_origin)
    with atomic_write(path, force) as file:
        format.write(file, in_frame(world.select(near_order(source, format.chunked)), format.frame), writing)
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
    check_positions(source, format, writing.force_lossy)
    world = _WorldSource(without_degrees(source, format.max_degree))
    with atomic_folder(folder, force) as place:
        small = None if preview is None else in_frame(_WorldSource(preview), format.frame)
        write_streamed_sog(place, in_frame(world, format.frame), layers, writing, small)
    return _notes(source, format)


def _notes(source: SceneSource, format: Format) -> tuple[str, ...]:
    notes: tuple[str, ...] = ()
    if source.sh_degree > format.max_degree:
        notes = (f"SH above degree {format.max_degree} left out: {format.suffix} holds no others",)
    if np.any(source.origin != 0) and not format.keeps_origin:
        notes += ("positions rounded to float32: the scene is far from zero",)
    return notes


def near_order(source: SceneSource, chunked: bool = False, chunk_rows: int = 65536) -> np.ndarray:
    """[N] i64, rows of `source` in the order that `write_foreign` writes them.

    They lie along a Morton curve through the box of the scene, far ones last, by octaves of their distance. In formats
    whose chunks share a range (`chunked`), near rows would lose their digits to far ones beside them, and chunks are as
    small as can be. One chunk has rows of both kinds: its near ones are the faintest.
    """
    means = np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(chunk_rows)], axis=1)
    order = chunk_order(means) if chunked else near_rows(means)
    away = means - np.median(means, axis=1, keepdims=True).astype(np.float64)
    distances = np.sqrt((away * away).sum(axis=0))
    limit = _FAR * float(np.median(distances))
    if not 0 < limit < np.max(distances):
        return order
    octaves = np.maximum(np.frexp(distances / limit)[1], 0)
    near = np.flatnonzero(octaves == 0)
    mixed = near.size % CHUNK
    if mixed:
        octaves[near[np.argsort(_areas(source, near), kind="stable")[:mixed]]] = 1
        octaves[distances > limit] += 1
    if chunked:
        groups = np.flatnonzero(octaves == 0), np.flatnonzero(octaves)
        return np.concatenate([rows[chunk_order(means[:, rows])] for rows in groups if rows.size])
    return order[np.argsort(octaves[order], kind="stable")]


def _areas(source: SceneSource, rows: np.ndarray) -> np.ndarray:
    """[n] f64, opacity times the square of the largest scale, scene units."""
    planes = source.read(rows, ["opacity_logits", "log_scales"])
    with np.errstate(over="ignore"):
        areas: np.ndarray = opacities(planes["opacity_logits"][0]) * np.exp(2.0 * planes["log_scales"].max(axis=0))
    return areas


@dataclass(frozen=True)
class Rounding:
    """What a format's positions lose of a scene, known before it is written."""

    moved: int  # Gaussians that rounding moves by more than their own size, that is their largest deviation
    error: float  # largest error of a position, scene units
    smallest: float  # size of the smallest splat, scene units


def rounding_of(source: SceneSource, format: Format, chunk_rows: int = 65536) -> Rounding:
    """What a format does to the positions of a scene. Raises `InputError` for coordinates beyond its reach."""
    origin = np.zeros(3) if format.keeps_origin else np.asarray(source.origin)
    largest, beyond = np.zeros(3), 0
    for rows in source.chunks(chunk_rows):
        sizes = np.abs(source.read(rows, ["means"])["means"] + origin[:, None])
        largest = np.maximum(largest, sizes.max(axis=1))
        beyond += int(np.count_nonzero(~(sizes <= format.reach).all(axis=0)))
    if beyond:
        raise InputError(
            f"{source.name}: {beyond} of {source.count} Gaussians lie beyond {format.reach:.0f}, the largest coordinate that "
            f"{format.suffix} holds; the farthest at {largest.max():g}: write a .fgs, .ply or .glb, or move the scene to zero"
        )
    moved, error, smallest = 0, 0.0, np.inf
    for rows in source.chunks(chunk_rows):
        planes = source.read(rows, ["means", "log_scales"])
        errors = format.position_error(planes["means"] + origin[:, None], float(largest.max()))
        with np.errstate(over="ignore"):
            sizes = np.exp(np.max(planes["log_scales"].astype(np.float64), axis=0))
        moved += int(np.count_nonzero(errors > sizes))
        error, smallest = max(error, float(errors.max())), min(smallest, float(sizes.min()))
    return Rounding(moved, error, smallest)


def check_positions(source: SceneSource, format: Format, force_lossy: bool = False) -> tuple[str, ...]:
    """Refuse a scene whose positions a format cannot hold, and warn of Gaussians that it moves.

    Of a scene far from zero, every position is held to a tenth of the smallest splat, or nearly as well as at zero. Of
    others, most Gaussians move by less than their own size. Returns warnings: none, or how many move by more.
    """
    found = rounding_of(source, format)
    too_coarse = found.error > found.smallest / 10 and bool(np.any(source.origin)) and not force_lossy
    if too_coarse and found.error > _FINER * rounding_of(MovedSource(source, np.zeros(3)), format).error:
        raise InputError(
            f"{source.name}: {format.suffix} holds these coordinates only to {found.error:.2g}, and the smallest splat "
            f"measures {found.smallest:.2g}: use --recenter, which writes the offset beside the file, write a .glb or a .fgs, "
            "or use --force-lossy"
        )
    if not found.moved:
        return ()
    words = (
        f"{found.moved} of {source.count} Gaussians move by more than their own size, since {format.suffix} rounds positions of "
        f"this scene by up to {found.error:.2g}"
    )
    if 2 * found.moved > source.count and not force_lossy:
        raise InputError(
            f"{source.name}: {words}. Write a .fgs, .ply or .glb, leave out what lies far away, or use --force-lossy"
        )
    return (words,)


def wants_double(source: SceneSource, chunk_rows: int = 65536) -> tuple[bool, tuple[str, ...]]:
    """Whether the positions of a PLY should be `double`, and warnings.

    They are what came in. Where a file does not tell, as a `.fgs`, floats do, unless they would move most Gaussians by more
    than their own size: such a scene did not come as floats.
    """
    if source.doubles is not None or not np.any(source.origin):
        return bool(source.doubles), ()
    found = rounding_of(source, Format(".ply", reader=""), chunk_rows)
    if 2 * found.moved > source.count:
        return True, ()
    if found.error <= found.smallest / 10:
        return False, ()
    words = (
        f"floats hold positions of this scene only to {found.error:.2g}, and the smallest splat measures {found.smallest:.2g}: "
        "--double keeps them as they are, where they came as doubles"
    )
    return False, (words,)


def offset_place(path: str | os.PathLike[str]) -> Path:
    """The file beside `path`, or beside the folder of a streamed scene, that holds the offset of one that was moved to zero."""
    place = Path(path).parent if Path(path).name == STREAMED else Path(path)
    return place.with_name(place.name + ".offset.json")


def write_offset(path: str | os.PathLike[str], origin: np.ndarray, format: Format, force: bool) -> str:
    """Write how far a scene was moved, in the axes of the file at `path`. Returns a note.

    Raises `InputError` if the offset's file exists and `force` is not set.
    """
    place, offset = offset_place(path), (origin * format.frame.signs + 0.0).tolist()
    with atomic_write(place, force) as file:
        file.write(json.dumps({"offset": offset, "axes": format.frame.name}, indent=1).encode() + b"\n")
    return f"moved to zero: add the offset in {place}"


class MovedSource(WrappedSource):
    """A scene that is moved as a whole: the same values around another origin."""

    def __init__(self, parent: SceneSource, origin: np.ndarray) -> None:
        super().__init__(parent)
        self.origin = origin


class _WorldSource(WrappedSource):
    """A scene as writers need it: world positions in float32, and unit quaternions.

    Most formats have no digits for an origin, and can only hold unit quaternions.
    """

    def __init__(self, parent: SceneSource, keep_origin: bool = False) -> None:
        super().__init__(parent)
        self.origin = parent.origin if keep_origin else np.zeros(3)
        self.moved = bool(np.any(parent.origin != self.origin))

    def change(self, planes: Planes) -> None:
        if "quats" in planes:
            planes["quats"][...] = normalize_quats(planes["quats"])
        if "means" in planes and self.moved:
            planes["means"][...] = planes["means"].astype(np.float64) + self.parent.origin[:, None]
