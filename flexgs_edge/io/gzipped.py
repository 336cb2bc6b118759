"""Scenes packed with gzip: unpacked into a temporary file that lives as long as the source."""

from __future__ import annotations

import gzip
import os
import shutil
import tempfile
import weakref
import zlib
from collections.abc import Callable
from pathlib import Path

from flexgs_edge.errors import BudgetError, FormatError, InputError
from flexgs_edge.files import DISK_FULL, check_readable
from flexgs_edge.scene.source import SceneSource

GZ = ".gz"
_BLOCK = 1 << 20
LEAST_FREE = 1 << 28  # Bytes of the temporary disk that stay free
MOST_TIMES = 200  # Scenes unpack to 1.1 to 10 times their size, and any gzip file to at most 1032 times
SMALL = 1 << 26  # Unpacked bytes that need no such bound


def unpacked(
    path: Path, name: str, open_file: Callable[[Path], SceneSource], least_free: int = LEAST_FREE
) -> SceneSource:
    """Unpack a file into the folder that TMPDIR names, and open it there.

    `path`: the packed file. `name`: the user's path, for messages. `open_file`: opens the unpacked file. `least_free`:
    bytes of the temporary disk that must stay free. Raises `InputError` if the file cannot be read. Raises
    `FormatError` if it is no whole gzip file, or unpacks to far more than a scene would. Raises `BudgetError` if the
    temporary disk has no room for it.
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
