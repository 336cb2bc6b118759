"""Check files before they are read, and write results so that each gets its name only when it is complete."""

import json
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, BinaryIO

from flexgs_edge.errors import DISK_FULL, BudgetError, FormatError, InputError, brief

_SPECIAL = {
    stat.S_IFIFO: "a pipe",
    stat.S_IFCHR: "a device",
    stat.S_IFBLK: "a device",
    stat.S_IFSOCK: "a socket",
    stat.S_IFDIR: "a folder",
}


def check_readable(path: str | os.PathLike[str], name: str | None = None) -> None:
    """Check that a path is a file. It is not opened: a pipe without a writer would wait for ever.

    `path`: the file. `name`: the path for messages. Default: `path`. Raises `InputError` if there is no such file, or
    it is not a regular one.
    """
    name = os.fspath(path) if name is None else name
    try:
        kind = stat.S_IFMT(os.stat(path).st_mode)
    except FileNotFoundError as error:
        if os.path.islink(path):
            raise InputError(f"{name}: a link to {os.readlink(path)}, which does not exist") from error
        raise InputError(f"{name}: no such file or folder") from error
    except OSError as error:  # such as a name that is too long, or a folder without permission to enter
        raise InputError(f"{name}: cannot read it ({error.strerror})") from error
    except ValueError as error:  # a name with a zero byte
        raise InputError(f"{name!r}: cannot be the name of a file") from error
    if kind != stat.S_IFREG:
        found = _SPECIAL.get(kind, "a special file")
        raise InputError(f"{name}: expected a file, found {found}; write what it holds to a file first")


def parse_json(text: bytes, name: object) -> Any:
    """The value of a JSON text, which messages call `name`. Raises `FormatError` if it is not JSON."""
    try:
        return json.loads(text)
    except json.JSONDecodeError as error:
        raise FormatError(
            f"{name}: not JSON: {error.msg} in line {error.lineno}, column {error.colno}; is it complete?"
        ) from error
    except (RecursionError, ValueError) as error:  # also bytes that are no text, and numbers of absurd length
        raise FormatError(f"{name}: not JSON: {brief(str(error))}") from error


def check_writable(path: str | os.PathLike[str], force: bool = False) -> Path:
    """Check, before any work is done, that a file can be written; returns its place with links followed.

    Raises `InputError` if the folder is missing, `path` is not a regular file, or it exists and `force` is not set.
    """
    target = Path(os.path.realpath(path))
    try:
        folder, exists, plain = target.parent.is_dir(), target.exists(), target.is_file()
    except OSError as error:  # such as a name that is too long, or a folder without permission to enter
        raise InputError(f"{path}: cannot write there ({error.strerror})") from error
    if not folder:
        raise InputError(f"{path}: the folder {target.parent} does not exist; make it first")
    # A rename would replace a device such as /dev/null by a file, so we refuse everything but plain files.
    if exists and not plain:
        raise InputError(f"{path}: expected a file name to write to, found a folder or a special file")
    if exists and not force:
        raise InputError(f"{path}: the file exists; choose another name or use -f to overwrite it")
    return target


@contextmanager
def atomic_write(path: str | os.PathLike[str], force: bool = False) -> Iterator[BinaryIO]:
    """Yield a binary file that gets the name `path` only if the block ends without an error.

    The file can be read and seeked. After any error (Ctrl-C included), no partial file is left, and an earlier file of
    that name stays as it was.

    `path`: place of the finished file; a symbolic link is followed. `force`: replace an existing file. Raises
    `InputError` if `path` cannot be written to (see `check_writable`). Raises `BudgetError` if the disk is full.
    """
    target = check_writable(path, force)
    # A random, short name: two runs never share it, and it fits where a long target name with a suffix would not.
    temporary = target.with_name(f".flexgs-{secrets.token_hex(8)}.tmp")
    try:
        with open(temporary, "x+b") as file:
            yield file
        os.replace(temporary, target)
    except OSError as error:
        _check_disk(path, error)
        # Other errors in the block, such as of files that it reads, are not explained here.
        if error.filename is not None and os.fspath(error.filename) == os.fspath(temporary):
            raise InputError(f"{path}: cannot write there ({error.strerror})") from error
        raise
    finally:
        with suppress(FileNotFoundError):
            temporary.unlink()


def _check_disk(path: object, error: OSError) -> None:
    """Raise `BudgetError` if an error says that the disk is full."""
    if error.errno in DISK_FULL:
        raise BudgetError(f"{path}: the disk is full ({error.strerror}); free some space or write elsewhere") from error


def check_folder(path: str | os.PathLike[str], force: bool = False) -> Path:
    """Check, before any work is done, that a folder can be written; returns its place with links followed.

    Raises `InputError` if its parent is missing, `path` is not a folder, or it is not empty and `force` is not set.
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
    except OSError as error:  # such as a name that is too long, or a folder without permission to enter
        raise InputError(f"-o {path}: cannot write there ({error.strerror})") from error
    return target


@contextmanager
def atomic_folder(path: str | os.PathLike[str], force: bool = False) -> Iterator[Path]:
    """Yield an empty folder; its files get to `path` only if the block ends without an error.

    After any error (Ctrl-C included), nothing is left behind. A new `path` appears as a whole. If the folder exists
    (with `force`, it may have contents), the finished files replace files of the same names, and all others stay.
    """
    target = check_folder(path, force)
    # Inside a folder that exists, since its parent may not be writable, or may be on another disk.
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
        _check_disk(f"-o {path}", error)
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
    """Yield a name in a temporary folder beside `output`.

    The file there becomes `output` if the block ends without an error. The folder is always removed. If `word` is
    given, the folder is named by it, and one left by a killed run is removed first.
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
