"""Writing a file whole or not at all: beside its place first, renamed when complete."""

from __future__ import annotations

import errno
import os
import secrets
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
