"""`info`: show what a scene file holds."""

import os
from pathlib import Path

from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.io.reading import Reading
from flexgs_edge.report.info_result import InfoResult
from flexgs_edge.run.open_scene import check_fgs, is_fgs, open_file
from flexgs_edge.scene.crop import cropped, usual_bounds
from flexgs_edge.scene.source import some_positions


def info(path: str | os.PathLike[str], crop: str | None = None) -> InfoResult:
    """Read what a scene file holds.

    `path`: a `.fgs`, a `.ply`, a file of another program's format, or a model folder. Of a `.fgs` only the header is
    read. One that was cut is decoded, which takes longer: only its symbols tell the bytes per channel. `crop`: as for
    `--crop`; of a `.fgs` its values are read then. Returns counts, settings, and the bytes of every channel of a `.fgs`.
    """
    place = Path(path)
    if is_fgs(place) and crop is None:
        # Imported here because it loads the coder, which a .ply does not need.
        from flexgs_edge.run.contents import contents

        check_fgs(place)
        return contents(place)
    return _scene_info(place, Reading.of(None, crop=crop))


def _scene_info(path: Path, reading: Reading) -> InfoResult:
    # Imported here because they load cameras, options and other formats, which a .fgs does not need.
    from flexgs_edge.run.inputs import companions_of

    opened = open_file(path, reading)
    source, beside = opened.source, companions_of(path)
    if reading.crop is not None:
        source = cropped(source, reading.crop)
    return InfoResult(
        path=source.name,
        format=opened.suffix.lstrip("."),
        size=opened.bytes,
        count=source.count,
        sh_count=source.sh_count,
        sh_degree=source.sh_degree,
        origin=tuple(source.origin.tolist()),
        source_ply_bytes=source.count * inria_dtype(source.sh_degree).itemsize,
        notes=tuple(source.notes),
        cameras=None if beside.cameras is None else os.fspath(beside.cameras),
        images=None if beside.images is None else os.fspath(beside.images),
        antialiased=source.settings.get("antialiased", beside.antialiased),
        format_version=opened.version,
        frame=opened.frame.name,
        bounds=usual_bounds(some_positions(source)),
    )
