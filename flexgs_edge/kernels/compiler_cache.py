"""The folder where PoCL keeps compiled kernels: one that can be written, without damaged files.

PoCL offers no device where it cannot write that folder, and ends the process where a file in it was cut.
"""

from __future__ import annotations

import os
import shutil
import struct
import tempfile
from functools import cache
from pathlib import Path
from typing import BinaryIO

from flexgs_edge.progress import LOG

VARIABLE = "POCL_CACHE_DIR"  # PoCL's own environment variable for the folder
SHARED_MEMORY = "/dev/shm"
STAMP = "flexgs-edge-checked"  # A file whose time is that of the last check
FLUSHED = 120.0  # Seconds after which a file is on the disk, even if the power fails
ELF, BITCODE = b"\x7fELF\x02\x01", b"BC\xc0\xde"


@cache
def prepare_compiler_cache() -> None:
    """Name another folder if PoCL's cannot be written, and remove its damaged entries, once in a process."""
    folder = compiler_cache()
    refused = _refused(folder)
    if refused is not None:
        other = next((place for place in _other_places() if _refused(place) is None and _is_ours(place)), None)
        if other is None:
            LOG.warning("%s cannot be written (%s): PoCL needs a folder there, or one in %s", folder, refused, VARIABLE)
            return
        LOG.warning("%s cannot be written (%s): compiled kernels are kept in %s", folder, refused, other)
        os.environ[VARIABLE] = os.fspath(other)
        folder = other
    damaged = _damaged(folder)
    for entry in damaged:
        shutil.rmtree(folder / entry, ignore_errors=True)
    if damaged:
        LOG.warning("%s: %d damaged entries were removed; their kernels are compiled anew", folder, len(damaged))


def compiler_cache() -> Path:
    """Where PoCL keeps compiled kernels."""
    named = os.environ.get(VARIABLE)
    caches = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(named) if named else Path(caches) / "pocl" / "kcache"


def _other_places() -> list[Path]:
    return [Path(parent) / f"flexgs-edge-{os.getuid()}" for parent in (tempfile.gettempdir(), SHARED_MEMORY)]


def _refused(folder: Path) -> str | None:
    """Why files cannot be made in a folder; None if they can."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.TemporaryFile(dir=folder):
            return None
    except OSError as error:
        return error.strerror or str(error)


def _is_ours(folder: Path) -> bool:
    """Whether nobody else could have put programs there."""
    found = folder.lstat()
    return found.st_uid == os.getuid() and not found.st_mode & 0o022 and not folder.is_symlink()


def _damaged(folder: Path) -> set[Path]:
    """Entries, relative to the folder, with a file that is shorter than it states. Older files were looked at before."""
    stamp = folder / STAMP
    since = stamp.stat().st_mtime - FLUSHED if stamp.exists() else -1.0
    damaged = set()
    for place, _, names in os.walk(folder):
        for name in names:
            if name.endswith((".bc", ".so")) and not _is_whole(os.path.join(place, name), since):
                damaged.add(Path(*Path(place).relative_to(folder).parts[:2]))
    stamp.touch()
    return damaged


def _is_whole(path: str, since: float) -> bool:
    """Whether a library or a program in LLVM's bitcode has the length that it states, or is older than `since`."""
    try:
        found = os.stat(path)
        size = found.st_size
        if found.st_mtime < since:
            return True
        with open(path, "rb") as file:
            return _elf_bytes(file) <= size if path.endswith(".so") else _bitcode_bytes(file, size) == size
    except (OSError, struct.error):
        return False


def _elf_bytes(file: BinaryIO) -> int:
    """Where the table of sections of a library ends, which linkers write last; of a kind unknown here 1."""
    head = file.read(64)
    if not head.startswith(ELF):
        return 1
    (sections,) = struct.unpack_from("<Q", head, 40)
    size, count = struct.unpack_from("<HH", head, 58)
    return int(sections + size * count)


def _bitcode_bytes(file: BinaryIO, size: int) -> int:
    """Where the last block of a program ends; of a kind unknown here `size`."""
    if file.read(4) != BITCODE:
        return size or 1
    at = 4
    while at < size:
        file.seek(at + 4)
        (words,) = struct.unpack("<I", file.read(4))
        at += 8 + 4 * words
    return at
