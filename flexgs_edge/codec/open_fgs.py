"""Open, read or verify a `.fgs` file, whatever its version."""

import os
import struct

from flexgs_edge.codec.sections import MAGIC, Section
from flexgs_edge.codec.v1 import container as v1
from flexgs_edge.codec.v1.container import Header
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.codec.v2 import container as v2
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_readable


def file_version(path: str | os.PathLike[str]) -> int:
    """2 for files of version 2, else 1: the reader of version 1 then says what is wrong with other files."""
    check_readable(path)
    try:
        with open(path, "rb") as file:
            start = file.read(10)
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error
    return 2 if start == MAGIC + struct.pack("<H", v2.VERSION) else 1


def open_fgs(path: str | os.PathLike[str]) -> FgsSource | GridSource:
    """Open a `.fgs` file as a scene source."""
    return GridSource(path) if file_version(path) == 2 else FgsSource(path)


def read_header(path: str | os.PathLike[str]) -> Header | GridHeader:
    """Read and check the header of a file; no values are read."""
    return v2.GridContainer(path).header if file_version(path) == 2 else v1.read_header(path)


def verify(path: str | os.PathLike[str], raise_errors: bool = True) -> list[Section]:
    """Check every byte of a file; see `flexgs_edge.codec.v1.container.verify`."""
    check = v2.verify_grid if file_version(path) == 2 else v1.verify
    return check(path, raise_errors)
