"""Scenes made of several named pieces: files beside each other in a folder, or in a zip."""

from __future__ import annotations

import os
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from flexgs_edge.errors import FormatError, brief

Pieces = Callable[[str], bytes]  # Gives the bytes of a piece by its name; raises `FormatError` if it is not there

_MOST_UNPACKED = 1 << 22
_MOST_GAIN = 8
"""A piece of a zip unpacks to at most this many bytes, and this many times its packed size. Pictures do not get smaller by
a second compression."""
_DAMAGED = (
    *(zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, struct.error, ValueError),
    *(OSError, OverflowError, IndexError, KeyError),
)  # What zipfile raises for files that it cannot read


def piece_place(folder: Path, piece: str, name: str) -> Path:
    """The file of a piece below a folder.

    Raises `FormatError` if the name leads out of the folder, also by a link.
    """
    inside = f"{name}: {brief(piece)}: expected the name of a file in its folder or below it"
    if not piece or "\\" in piece or ":" in piece or os.path.isabs(piece) or ".." in piece.split("/"):
        raise FormatError(inside)
    try:
        root, place = os.path.realpath(folder), os.path.realpath(folder / piece)
    except (OSError, ValueError):
        raise FormatError(f"{inside}, found one that no file can have") from None
    if os.path.commonpath([root, place]) != root:
        raise FormatError(f"{inside}, found a link that leads out of it")
    return Path(place)


def is_there(folder: Path, piece: str, name: str) -> bool:
    """Whether a piece below a folder is a file."""
    try:
        return piece_place(folder, piece, name).is_file()
    except OSError:  # such as a name that is too long
        return False


def folder_pieces(folder: Path, name: str) -> Pieces:
    """Pieces that are files in a folder or below it. `name` is what messages call the scene."""

    def read(piece: str) -> bytes:
        place = piece_place(folder, piece, name)
        if not is_there(folder, piece, name):
            raise FormatError(f"{name}: {brief(piece)}: no such file in its folder; was everything copied?")
        return place.read_bytes()

    return read


def zip_pieces(archive: zipfile.ZipFile, name: str, first: str) -> Pieces:
    """Pieces in a zip."""
    entries = {info.filename: info for info in archive.infolist()}
    homes = [entry[: -len(first)] for entry in entries if entry == first or entry.endswith(f"/{first}")]
    if not homes:
        raise FormatError(f"{name}: expected a zip with {first}, found {brief(sorted(entries))}")
    home = min(homes, key=len)

    def read(piece: str) -> bytes:
        info = entries.get(home + piece)
        if info is None:
            raise FormatError(f"{name}: {brief(piece)}: not in the zip; found {brief(sorted(entries), 200)}")
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FormatError(
                f"{name}: {piece}: expected a stored or deflated entry, found method {info.compress_type}"
            )
        if info.file_size > _MOST_UNPACKED + _MOST_GAIN * info.compress_size:
            raise FormatError(
                f"{name}: {piece}: {info.compress_size} bytes claim to unpack to {info.file_size}: no picture does that"
            )
        try:
            with archive.open(info) as file:
                return file.read(info.file_size)
        except _DAMAGED as error:
            raise FormatError(f"{name}: {piece}: cannot be unpacked ({error}); is the file complete?") from error

    return read


def open_zip(path: Path, name: str) -> zipfile.ZipFile:
    """Open a zip; `name` is what messages call it.

    Raises `FormatError` if it is none.
    """
    path.stat()  # the file can be read, or this error says why not
    try:
        return zipfile.ZipFile(path)
    except _DAMAGED as error:
        raise FormatError(f"{name}: expected a zip ({error}); is it complete?") from error
