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
    """Yield an empty folder beside `path` that takes its name only when the block ends without an error.

    On any error (Ctrl-C included) nothing is left behind. Where `path` holds files already (`force`), each finished file
    takes the place of one of the same name, and files of other names stay as they are.
    """
    target = check_folder(path, force)
    place = target.with_name(f".flexgs-{secrets.token_hex(8)}.tmp")
    try:
        place.mkdir()
        yield place
        check_folder(path, force)
        if target.is_dir() and any(target.iterdir()):
            _merge(place, target)
        else:
            os.replace(place, target)
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
