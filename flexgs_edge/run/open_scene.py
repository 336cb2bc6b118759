"""Open a scene file with the reader of its format: that of its suffix, or of its first bytes for every kind of PLY."""

import gzip
import os
import shutil
import tempfile
import weakref
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from flexgs_edge.errors import DISK_FULL, BudgetError, FormatError, InputError
from flexgs_edge.files import check_readable
from flexgs_edge.io.formats import FORMATS, format_of
from flexgs_edge.io.frames import RDF, Frame, FrameSource, in_frame
from flexgs_edge.io.kinds import GZIP_MAGIC, Kind, kind_of
from flexgs_edge.io.model_folder import latest_iteration
from flexgs_edge.io.ply import PlySource
from flexgs_edge.io.reading import AS_WRITTEN, Reading
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.scene.source import SceneSource

FOLDERS = ("lod-meta.json", "meta.json")  # Files that make a folder a scene, the first that is there
SUFFIXES = (".fgs", ".ply", *FORMATS)
_PLY = (".ply", ".compressed.ply")
"""Formats that a file has if its first bytes say so, whatever its suffix: both are called .ply in the wild."""
GZ = ".gz"
_BLOCK = 1 << 20
LEAST_FREE = 1 << 28  # Bytes of the temporary disk that stay free
MOST_TIMES = 200  # Scenes unpack to 1.1 to 10 times their size, and any gzip file to at most 1032 times
SMALL = 1 << 26  # Unpacked bytes that need no such bound


@dataclass(frozen=True)
class Opened:
    """An open scene, and what is known of its file."""

    source: SceneSource  # with its axes in RDF
    suffix: str  # suffix of the file's format, which its name may lack
    bytes: int  # bytes of the file as it lies there, packed or not; of all files that are read, where there are several
    frame: Frame  # directions of the axes in the file
    version: int | None  # version of the format, if the file states one


def open_file(path: str | os.PathLike[str], reading: Reading = AS_WRITTEN) -> Opened:
    """Open a scene file by its suffix, the latest iteration of INRIA's model folder, or a folder of SOG pictures.

    A folder that holds a `point_cloud.ply` stands for it. Raises `InputError` if the path does not exist or its suffix is
    unknown. Raises `FormatError` if the file does not follow its format.
    """
    place = scene_file(path)
    if reading.lod is not None and not place.name.lower().endswith("lod-meta.json"):
        raise InputError(
            f"{path}: --lod is for streamed scenes (lod-meta.json), and this file has one level: leave it out"
        )
    if reading.budget is None:
        reading = replace(reading, budget=MemoryBudget.from_limit(None))
    suffix, source = _open(place, place.name, os.fspath(place), reading)
    inner = source.parent if isinstance(source, FrameSource) else source
    size = inner.file_bytes or os.stat(place).st_size
    frame = source.frame if isinstance(source, FrameSource) else RDF
    return Opened(source, suffix, size, frame, inner.version)


def scene_file(path: str | os.PathLike[str]) -> Path:
    """The scene file that a path stands for: the file itself, or the one in the folder."""
    place = Path(path)
    if os.path.isdir(place):
        found = next((place / name for name in FOLDERS if os.path.isfile(place / name)), None)
        return found or latest_iteration(place)
    if not os.path.lexists(place):
        raise InputError(f"{path}: no such file or folder; {_supported()}")
    check_readable(place)
    return place


def is_fgs(path: Path) -> bool:
    """Whether a path is read as a `.fgs`: by its suffix, unless its first bytes are those of a PLY."""
    if path.suffix.lower() != ".fgs":
        return False
    check_readable(path)
    found = kind_of(path, os.fspath(path))
    return found is None or found.suffix not in _PLY


def check_fgs(path: Path) -> None:
    """Raise `InputError` for a path that is no file, or for a file whose first bytes are those of something else."""
    check_readable(path)
    found = kind_of(path, os.fspath(path))
    if found is not None and found.suffix != ".fgs":
        raise _refused(found, os.fspath(path))


def _open(place: Path, file_name: str, name: str, reading: Reading) -> tuple[str, SceneSource]:
    """Open `place`, whose format `file_name` tells; messages call it `name`. Also returns the suffix of its format."""
    lower = file_name.lower()
    found = kind_of(place, name)
    if lower.endswith(GZ):
        with open(place, "rb") as file:
            packed = file.read(len(GZIP_MAGIC)) == GZIP_MAGIC
        if packed:
            suffixes = []

            def open_inner(inner: Path) -> SceneSource:
                suffix, source = _open(inner, file_name[: -len(GZ)], name, reading)
                suffixes.append(suffix)
                return source

            source = unpacked(place, name, open_inner)
            return suffixes[0], source
        if found is None:
            raise FormatError(f"{name}: not a gzip file; is it complete?")
        lower = file_name[: -len(GZ)].lower()  # browsers unpack files without a word, and keep their names
    format = format_of(lower)
    suffix = format.suffix if format else Path(lower).suffix
    note: tuple[str, ...] = ()
    if found is not None and suffix != found.suffix and suffix not in found.hosts:
        if found.suffix not in _PLY:
            raise _refused(found, name)
        suffix, note = str(found.suffix), (f"read as {found.words}, as its first bytes say",)
    if suffix in FORMATS:
        # Imported only for these files, so that `info` of the others starts soon.
        from flexgs_edge.io.exchange import read_foreign

        source = read_foreign(place, reading, name, FORMATS[suffix])
        source.notes += note
        return suffix, source
    if suffix == ".ply":
        source = in_frame(PlySource(place, name=name, reading=reading), reading.frame or RDF)
        source.notes += note
        return suffix, source
    if suffix != ".fgs":
        what = f"unknown kind of scene {suffix!r}" if suffix else "its name has no suffix that tells what it is"
        raise InputError(f"{name}: {what}; {_supported()}")
    if os.fspath(place) != name:
        raise InputError(f"{name}: a .fgs does not get smaller by gzip; unpack it first: gunzip {name}")
    # Imported only for these files, so that the others start without the coder.
    from flexgs_edge.codec.open_fgs import open_fgs

    return suffix, in_frame(open_fgs(place), reading.frame or RDF)


def _refused(kind: Kind, name: str) -> FormatError:
    return kind.refused(name) if kind.suffix is None else kind.renamed(name, SUFFIXES)


def _supported() -> str:
    suffixes = ", ".join(SUFFIXES)
    return f"supported: files ending in {suffixes}, each also with {GZ}, or a model folder with point_cloud/iteration_*"


def unpacked(
    path: Path, name: str, open_file: Callable[[Path], SceneSource], least_free: int = LEAST_FREE
) -> SceneSource:
    """Unpack a file into the folder that TMPDIR names, and open it there.

    `path`: the packed file. `name`: the user's path, for messages. `open_file`: opens the unpacked file. `least_free`: bytes of
    the temporary disk that must stay free. Raises `InputError` if the file cannot be read. Raises `FormatError` if it is no
    whole gzip file, or unpacks to far more than a scene would. Raises `BudgetError` if the temporary disk has no room for it.
    """
    check_readable(path, name)
    folder = tempfile.TemporaryDirectory(prefix="flexgs-")
    try:
        place = Path(folder.name) / "scene"
        _unpack(path, name, place, least_free)
        source = open_file(place)
    except BaseException:
        folder.cleanup()
        raise
    weakref.finalize(source, folder.cleanup)
    return source


def _unpack(path: Path, name: str, place: Path, least_free: int) -> None:
    try:
        most, size = max(SMALL, MOST_TIMES * os.stat(path).st_size), 0
        with gzip.open(path) as packed, open(place, "wb") as file:
            while block := packed.read(_BLOCK):
                size += len(block)
                if size > most:
                    raise FormatError(
                        f"{name}: unpacks to more than {most} bytes, {MOST_TIMES} times its size: this is no scene; if it is, "
                        "unpack it first with gunzip"
                    )
                file.write(block)
                free = shutil.disk_usage(place.parent).free
                if free < least_free:
                    raise BudgetError(
                        f"{name}: unpacked, it does not fit into {place.parent.parent}: {free} bytes are left there; "
                        "free some space, or let TMPDIR name another folder"
                    )
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise FormatError(f"{name}: not a whole gzip file ({error}); is it complete?") from error
    except OSError as error:
        if error.errno in DISK_FULL:
            raise BudgetError(
                f"{name}: the disk is full while it is unpacked; let TMPDIR name another folder"
            ) from error
        raise InputError(f"{name}: cannot read the scene ({os.strerror(error.errno or 0)})") from error
