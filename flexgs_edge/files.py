"""Files and folders of results: each appears whole, under its name, or not at all."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from flexgs_edge.errors import BudgetError, InputError

DISK_FULL = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG}


def check_writable(path: str | os.PathLike[str], force: bool = False) -> Path:
    """The place that `path` names (links followed), or an error before any work is done.

    Raises
    ------
    InputError
        When the folder is missing, `path` is no regular file, or it exists and `force` is not set.
    """
    target = Path(os.path.realpath(path))
    try:
        folder, exists, plain = target.parent.is_dir(), target.exists(), target.is_file()
    except OSError as error:  # a name too long, a folder that may not be entered
        raise InputError(f"{path}: cannot write there ({error.strerror})") from error
    if not folder:
        raise InputError(f"{path}: the folder {target.parent} does not exist; make it first")
    # A rename would replace a device node such as /dev/null by a file: refuse whatever is not a plain file.
    if exists and not plain:
        raise InputError(f"{path}: expected a file name to write to, found a folder or a special file")
    if exists and not force:
        raise InputError(f"{path}: the file exists; choose another name or use -f to overwrite it")
    return target


@contextmanager
def atomic_write(path: str | os.PathLike[str], force: bool = False) -> Iterator[BinaryIO]:
    """Yield a binary file that takes the name `path` only when the block ends without an error.

    The file is seekable and may be read back. On any error (Ctrl-C included) nothing is left behind and an
    earlier file of that name is untouched.

    Parameters
    ----------
    path : path
        Where the finished file shall be; a symbolic link is followed.
    force : bool, optional
        Replace a file that exists.

    Raises
    ------
    InputError
        When `path` cannot be written to (see `check_writable`).
    BudgetError
        When the disk is full.
    """
    target = check_writable(path, force)
    # Named afresh and short: two runs never share it, and a long target name does not outgrow the file system's limit.
    temporary = target.with_name(f".flexgs-{secrets.token_hex(8)}.tmp")
    try:
        with open(temporary, "x+b") as file:
            yield file
        os.replace(temporary, target)
    except OSError as error:
        if error.errno in DISK_FULL:
            raise BudgetError(
                f"{path}: the disk is full ({error.strerror}); free some space or write elsewhere"
            ) from error
        # Errors of files read inside the block are not ours to explain.
        if error.filename is not None and os.fspath(error.filename) == os.fspath(temporary):
            raise InputError(f"{path}: cannot write there ({error.strerror})") from error
        raise
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


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


@contextmanager
def temporary_name(output: Path, force: bool, word: str | None = None) -> Iterator[Path]:
    """A name in a folder beside `output` that becomes `output` when the block ends well; the folder is removed in any case.

    With a `word` the folder is named by it, and one that a killed run left is removed first.
    """
    target = check_writable(output, force)
    folder = target.with_name(f".flexgs-out-{word or secrets.token_hex(8)}")
    shutil.rmtree(folder, ignore_errors=True)
    try:
        folder.mkdir()
    except OSError as error:
        raise InputError(f"{output}: cannot write there ({error.strerror})") from error
    try:
        yield folder / f"scene{target.suffix}"
        check_writable(output, force)
        os.replace(folder / f"scene{target.suffix}", target)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
