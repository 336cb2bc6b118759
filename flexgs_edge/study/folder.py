"""A folder of results that appears whole, under its name, or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.scene.atomic import DISK_FULL


def check_folder(path: str | os.PathLike[str], force: bool = False) -> Path:
    """The place that `path` names (links followed), or an error before any work is done.

    Raises
    ------
    InputError
        When its parent is missing, it is no folder, or it holds something and `force` is not set.
    """
    target = Path(os.path.realpath(path))
    try:
        if not target.parent.is_dir():
            raise InputError(f"-o {path}: the folder {target.parent} does not exist; make it first")
        if target.exists() and not target.is_dir():
            raise InputError(f"-o {path}: expected a folder to write to, found a file")
        if not force and target.is_dir() and any(target.iterdir()):
            raise InputError(
                f"-o {path}: the folder is not empty; choose another name, or use -f to overwrite files of the same names"
            )
        if not os.access(target if target.is_dir() else target.parent, os.W_OK | os.X_OK):
            raise InputError(f"-o {path}: cannot write there (permission denied)")
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"-o {path}: cannot write there ({error.strerror})") from error
    return target


@contextmanager
def atomic_folder(path: str | os.PathLike[str], force: bool = False) -> Iterator[Path]:
    """Yield an empty folder whose files get to `path` only when the block ends without an error.

    On any error (Ctrl-C included) nothing is left behind. A new `path` appears whole. Where there is such a folder (with
    `force` also one that is in use), the finished files take the places of those of the same names, and all others stay.
    """
    target = check_folder(path, force)
    # Inside a folder that is there: its parent may be closed to us, or on another disk.
    home = target if target.is_dir() else target.parent
    place = home / f".flexgs-{secrets.token_hex(8)}.tmp"
    try:
        place.mkdir()
        yield place
        if target.is_dir():
            _merge(place, target)
        else:
            os.rename(place, target)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise BudgetError(
                f"-o {path}: the disk is full ({error.strerror}); free some space or write elsewhere"
            ) from error
        raise
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _merge(source: Path, target: Path) -> None:
    """Move every file of `source` to its place under `target`."""
    for file in sorted(path for path in source.rglob("*") if path.is_file()):
        to = target / file.relative_to(source)
        to.parent.mkdir(parents=True, exist_ok=True)
        os.replace(file, to)
