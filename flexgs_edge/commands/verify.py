"""`verify`: check every byte of a `.fgs` file against its checksums."""

import os
from pathlib import Path

from flexgs_edge.codec.open_fgs import verify as verify_container
from flexgs_edge.errors import InputError
from flexgs_edge.report.file_results import VerifyResult
from flexgs_edge.run.open_scene import check_fgs


def verify(path: str | os.PathLike[str]) -> VerifyResult:
    """Check every checksum of a `.fgs` file. A damaged part is reported, not raised.

    `path`: the `.fgs` file. Returns whether each part is whole. Raises `FormatError` if the header is damaged: the
    parts behind it cannot be found then.
    """
    place = Path(path)
    if os.path.isdir(place) or (os.path.exists(place) and place.suffix.lower() != ".fgs"):
        raise InputError(f"{path}: expected a .fgs file: other formats have no checksums to verify")
    check_fgs(place)
    return VerifyResult(os.fspath(path), tuple(verify_container(place, raise_errors=False)))
