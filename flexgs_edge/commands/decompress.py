"""`decompress`: write a scene as a PLY that every viewer opens, or in another program's format."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.codec.v2.container import GridContainer, Preview
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_folder, check_writable
from flexgs_edge.io.exchange import (
    MovedSource,
    check_positions,
    offset_place,
    wants_double,
    write_foreign,
    write_offset,
    write_streamed,
)
from flexgs_edge.io.formats import FORMATS, WRITTEN, Format, written_format
from flexgs_edge.io.ply import inria_dtype, write_ply
from flexgs_edge.io.reading import AS_WRITTEN, PLAIN, Reading, Writing
from flexgs_edge.io.streamed_sog_writer import STREAMED
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import LOG
from flexgs_edge.report.file_results import DecompressResult
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.conversion import conversion_loss
from flexgs_edge.run.decoding import ahead, decode_bytes, decoded_once, decoder
from flexgs_edge.run.inputs import CheckedScene, ScenePlace, load_scene, scene_info
from flexgs_edge.run.open_scene import is_fgs, scene_file
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, ViewOptions
from flexgs_edge.run.spent import run_info
from flexgs_edge.scene.source import SceneSource

WRITE_COPIES = 3
"""Copies of a chunk's rows in memory while decoding and writing: codes, planes, rows of the PLY."""
LEAST_ROWS = 1024  # Rows of a PLY that are written at a time, at least
SPARE_SHARE = 8
"""Of what decoding takes, one part in so many is left free beside rows of a PLY: docs/results/tuning.md#heap"""
WARN_DROP = 0.5
"""We warn of a conversion whose pictures lose more than this, dB."""
ANTIALIASED_NOTE = "an antialiased model: the file does not say so; viewers must be told, and here --antialiased"


def decompress(
    input: ScenePlace,
    output: str | os.PathLike[str],
    force: bool = False,
    memory_limit: int | None = None,
    device: str | None = None,
    reading: Reading = AS_WRITTEN,
    writing: Writing = PLAIN,
    recenter: bool = False,
    cameras: str | None = None,
) -> DecompressResult:
    """Decode a scene to a PLY in INRIA's layout, or convert it to another format.

    The PLY is little endian with zero normals, and is written chunk by chunk. Its positions have the type that came in.

    Parameters
    ----------
    input : path or CheckedScene
        Any scene: a `.fgs`, a `.ply`, a file of another program's format, or a model folder.
    output : path
        The `.ply`, `.spz`, `.sog` or `.compressed.ply` to write, or `FOLDER/lod-meta.json` for streamed SOG.
    force : bool
        Overwrite `output` if it exists. Default: raise `InputError`.
    memory_limit : int, optional
        Bytes for the whole process. Default: three quarters of the free memory.
    reading : Reading, optional
        Frame, level of detail and SH degree.
    writing : Writing, optional
        How the file is written.
    recenter : bool
        Move a scene that lies far from zero to zero, and write the offset beside `output` (other programs' formats).
    cameras : str, optional
        Cameras of the pictures that tell what another program's format loses; `none`: no pictures. Default: those beside the
        scene, else generated ones.
    device : str, optional
        Device that decodes and draws: a processor as `devices` lists it, or `numpy`. Default: see `decoder`.

    Returns
    -------
    DecompressResult
        Paths, sizes, times and memory.

    Raises
    ------
    InputError
        If a path or a format is not usable.
    FormatError
        If the input does not follow its format.
    """
    streamed = Path(output).name == STREAMED
    format = FORMATS[".sog"] if streamed else written_format(output, writing)
    if format is None and Path(output).suffix.lower() != ".ply":
        raise InputError(f"-o {output}: expected a name that ends in .ply, {', '.join(WRITTEN)}, or {STREAMED}")
    if streamed:
        check_folder(Path(output).parent, force)
    else:
        check_writable(output, force)
    if format is None and (recenter or writing.force_lossy):
        raise InputError(
            f"--{'recenter' if recenter else 'force-lossy'}: a .ply holds the scene as it is; leave it out, or write one of "
            f"{', '.join(WRITTEN)}"
        )
    if format is not None and writing.double:
        raise InputError(f"--double: only a .ply has positions of another type, not {format.suffix}; leave it out")
    if cameras not in (None, AUTO_CAMERAS, NO_CAMERAS):
        read_cameras(cameras)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(memory_limit)
    with clock.stage("open"):
        scene = load_scene(input, reading=replace(reading, budget=budget))
        enough = budget.used + scene.held_bytes + _writing_bytes(scene.source, format)
        budget.foreseen = lambda: enough
        budget.take("reading the scene", scene.held_bytes)
        recenter = recenter and bool(np.any(scene.source.origin))
        if recenter:
            check_writable(offset_place(output), force)
    antialiased = scene.settings.get("antialiased") is True
    backend = decoder(device, scene.source, budget, clock)
    warnings: tuple[str, ...] = ()
    with clock.stage("write"):
        if format is not None:
            needed = format.memory * scene.source.count
            budget.require(f"writing a {format.suffix}", needed)
            source = decoded_once(scene.source, budget, needed, backend)
            scene = replace(scene, source=source)
            source = MovedSource(source, np.zeros(3)) if recenter else source
            warnings = check_positions(source, format, writing.force_lossy)
            writing = replace(writing, antialiased=antialiased, force_lossy=True)  # positions are checked
            if streamed:
                layers, preview = _layers(input, source.count, reading)
                notes = write_streamed(
                    Path(output).parent, source, layers, preview=preview, force=force, writing=writing
                )
            else:
                notes = write_foreign(output, source, force=force, writing=writing)
        else:
            row = WRITE_COPIES * inria_dtype(scene.source.sh_degree).itemsize
            least, decoding = min(scene.source.count, LEAST_ROWS), decode_bytes(scene.source, backend)
            rows = budget.rows("decoding", row, fixed=decoding + decoding // SPARE_SHARE, minimum=least, most=65536)
            budget.take("writing rows", row * rows)  # what is left decodes further chunks ahead
            with ahead(scene.source, budget, backend):
                double, warnings = (True, ()) if writing.double else wants_double(scene.source, rows)
                notes = write_ply(output, scene.source, force=force, chunk_rows=rows, double=double)
        if recenter:
            assert format is not None
            notes = (*notes, write_offset(output, scene.source.origin, format, force))
        if antialiased and not (format is not None and format.marks_antialiased):
            notes = (*notes, ANTIALIASED_NOTE)
    size = _written_bytes(Path(output)) if streamed else os.stat(output).st_size
    loss = None
    if format is not None:
        options = ViewOptions(cameras=cameras, device=device, memory_limit=memory_limit)
        with clock.stage("compare"):
            loss = conversion_loss(scene, output, options, None if streamed else format, recentred=recenter)
        if loss.drop is not None and loss.drop > WARN_DROP:
            warnings += (
                f"the pictures lose {loss.drop:.2f} dB, since {format.suffix} does not hold all of this scene; "
                f"flexgs-edge decompress {scene.path or 'SCENE'} -o OUT.ply loses nothing",
            )
    for warning in warnings:
        LOG.warning("warning: %s", warning)
    info = run_info(budget, clock, backend)
    return DecompressResult(scene_info(scene), os.fspath(output), size, info, notes, loss, warnings)


def _writing_bytes(source: SceneSource, format: Format | None) -> int:
    """Bytes that decoding and writing take at least."""
    decoding = decode_bytes(source, None)
    if format is not None:
        return format.memory * source.count + decoding
    return (
        WRITE_COPIES * inria_dtype(source.sh_degree).itemsize * min(source.count, LEAST_ROWS)
        + decoding
        + decoding // SPARE_SHARE
    )


def _layers(input: ScenePlace, count: int, reading: Reading) -> tuple[tuple[int, ...], SceneSource | None]:
    """Gaussians of each layer of a layered `.fgs`, and its preview, if there is one; other scenes have one layer.

    Where the scene is turned, its preview is left out.
    """
    if not isinstance(input, CheckedScene):
        place = scene_file(input)
        header = read_header(place) if is_fgs(place) else None
        if isinstance(header, GridHeader) and sum(header.layers) == count:
            wanted = header.preview.length and reading.frame is None
            preview = GridSource(place, Preview(GridContainer(place))) if wanted else None
            return tuple(header.layers), preview
    return (count,), None


def _written_bytes(output: Path) -> int:
    """Bytes of a streamed scene: its `lod-meta.json` and all files that it names."""
    names: list[str] = json.loads(output.read_bytes())["filenames"]
    folders = [output.parent / name for name in names]
    return output.stat().st_size + sum(file.stat().st_size for place in folders for file in place.parent.iterdir())
