"""`trim`: make a smaller file from a layered one, by copying whole layers."""

import os
from pathlib import Path

from flexgs_edge.codec.open_fgs import file_version, read_header
from flexgs_edge.codec.v1.container import Header
from flexgs_edge.codec.v2.container import trim_container
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_writable
from flexgs_edge.report.file_results import TrimResult
from flexgs_edge.run.open_scene import check_fgs


def trim(
    input: str | os.PathLike[str], output: str | os.PathLike[str], max_size: int, force: bool = False
) -> TrimResult:
    """Copy as many whole layers of a `.fgs` file as fit into a size; its preview if none does. Takes as long as copying the file.

    `input`: a `.fgs` of version 2. The original scene and cameras are not needed. `output`: the `.fgs` to write.
    `max_size`: most bytes of the new file. `force`: overwrite `output` if it exists. Default: raise `InputError`.
    Returns layers, Gaussians and bytes kept. Raises `InputError` if the file has no layers. Raises `FormatError` if the
    file is damaged. Raises `TargetError` if neither the first layer nor the preview fits.
    """
    if max_size < 1:
        raise InputError(f"--max-size {max_size}: expected at least 1 byte")
    if Path(output).suffix.lower() != ".fgs":
        raise InputError(f"-o {output}: expected a name that ends in .fgs")
    check_writable(output, force)
    if Path(input).suffix.lower() != ".fgs":
        raise InputError(f"{input}: expected a .fgs file: only these have layers to cut at")
    check_fgs(Path(input))
    header = read_header(input)
    if file_version(input) != 2:
        raise InputError(
            f"{input}: a .fgs of version 1 has no layers to cut at; compress the original with --method best"
        )
    size = trim_container(input, output, max_size, force)
    kept = read_header(output)
    return TrimResult(
        input=os.fspath(input),
        input_size=os.stat(input).st_size,
        input_count=header.count,
        input_layers=_layers(header),
        output=os.fspath(output),
        size=size,
        count=kept.count,
        layers=_layers(kept),
        max_size=max_size,
        is_preview=kept.count != header.count and isinstance(kept, GridHeader) and kept.cut_from is None,
    )


def _layers(header: Header | GridHeader) -> int:
    return len(header.layers) if isinstance(header, GridHeader) else 1
