"""`trim`: a smaller file from a layered one, by copying whole layers. Text and JSON come from one builder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.codec.open_fgs import file_version, read_header
from flexgs_edge.codec.v2.container import trim_container
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_writable
from flexgs_edge.units import format_size


def trim(input: str | Path, output: str | Path, max_size: int, force: bool = False) -> dict[str, Any]:
    """Copy as many whole layers of a `.fgs` file as fit into a size, at the speed of copying.

    Parameters
    ----------
    input : path
        A `.fgs` of version 2; neither the original nor cameras are needed.
    output : path
        The `.fgs` to write.
    max_size : int
        Bytes that it may have.
    force : bool
        Overwrite `output` if it exists.

    Returns
    -------
    dict
        JSON values (`trim_text` makes the text from them).

    Raises
    ------
    InputError
        For files without layers; `FormatError` for damaged ones.
    TargetError
        When not even the first layer fits.
    """
    if max_size < 1:
        raise InputError(f"--max-size {max_size}: expected at least 1 byte")
    if Path(output).suffix.lower() != ".fgs":
        raise InputError(f"-o {output}: expected a name that ends in .fgs")
    check_writable(output, force)
    if Path(input).suffix.lower() != ".fgs":
        raise InputError(f"{input}: expected a .fgs file: only these have layers to cut at")
    header = read_header(input)
    if file_version(input) != 2:
        raise InputError(
            f"{input}: a .fgs of version 1 has no layers to cut at; compress the original with --method best"
        )
    size = trim_container(input, output, max_size, force)
    kept = read_header(output)
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "trim",
        "input": os.fspath(input),
        "input_size": os.stat(input).st_size,
        "input_count": header.count,
        "input_layers": _layers(header),
        "output": os.fspath(output),
        "size": size,
        "count": kept.count,
        "layers": _layers(kept),
        "max_size": max_size,
    }


def _layers(header: Any) -> int:
    return len(header.layers)


def trim_text(found: dict[str, Any]) -> str:
    """The text of what `trim` did."""
    lines = [
        f"{found['input']}: {found['input_size']} bytes ({format_size(found['input_size'])}), "
        f"{found['input_count']} Gaussians in {found['input_layers']} layers",
        f"wrote {found['output']}, {found['size']} bytes ({format_size(found['size'])}, {found['max_size']} allowed)",
        f"kept  {found['layers']} of {found['input_layers']} layers, {found['count']} of {found['input_count']} Gaussians",
    ]
    return "\n".join(lines) + "\n"
