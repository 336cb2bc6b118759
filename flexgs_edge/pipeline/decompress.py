"""`decompress`: a scene to a PLY that every viewer opens, or to another program's format."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.codec import GridSource
from flexgs_edge.codec.coder import CHUNK_ROWS
from flexgs_edge.errors import InputError
from flexgs_edge.formats import FORMATS, check_converter, converter_bytes, format_of, write_foreign
from flexgs_edge.pipeline.inputs import load_scene
from flexgs_edge.pipeline.records import scene_info
from flexgs_edge.pipeline.workspace import Stopwatch, run_info
from flexgs_edge.report.result import DecompressResult
from flexgs_edge.scene import SceneSource, check_writable, inria_dtype, write_ply

WRITE_COPIES = 3
"""Times a chunk's rows that decoding and writing hold at once: codes, planes, rows of the PLY."""
DECODE_BYTES = 800
"""Bytes a row that decoding a chunk holds: codes, features, neighbours' weights, sums."""

ANTIALIASED_NOTE = "an antialiased model: the file does not say so; viewers must be told, and here --antialiased"


def ahead(source: SceneSource, budget: MemoryBudget) -> AbstractContextManager[None]:
    """Decoding of the next chunks while one is written, where memory allows."""
    if not isinstance(source, GridSource):
        return nullcontext()
    threads = source.threads
    chunk = min(source.count, CHUNK_ROWS) * DECODE_BYTES
    while threads > 1 and budget.free < (threads + 1) * chunk:
        threads -= 1
    return source.whole_in_order(threads)


def decompress(
    input: str | Path, output: str | Path, force: bool = False, memory_limit: int | None = None
) -> DecompressResult:
    """Decode a scene to a PLY in INRIA's layout (little endian, zero normals), chunk by chunk, or convert it.

    Parameters
    ----------
    input : path
        Any scene: a `.fgs`, a `.ply`, a file of another program's format, or a model folder.
    output : path
        The `.ply`, `.spz`, `.sog` or `.compressed.ply` to write.
    force : bool
        Overwrite `output` if it exists.
    memory_limit : int, optional
        Bytes for the whole process.
    """
    format = format_of(output)
    if format is None and Path(output).suffix.lower() != ".ply":
        raise InputError(f"-o {output}: expected a name that ends in .ply, {', '.join(FORMATS)}")
    if format is not None:
        check_converter(output)
    check_writable(output, force)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(memory_limit)
    with clock.stage("open"):
        scene = load_scene(input)
    with clock.stage("write"):
        if format is not None:
            budget.require("the converter", converter_bytes(format, scene.source.count))
            notes = write_foreign(output, scene.source, force=force)
        else:
            row = inria_dtype(scene.source.sh_degree).itemsize
            rows = budget.rows("decoding", WRITE_COPIES * row, minimum=min(scene.source.count, 1024), most=65536)
            with ahead(scene.source, budget):
                notes = write_ply(output, scene.source, force=force, chunk_rows=rows)
        if scene.settings.get("antialiased") is True:
            notes = (*notes, ANTIALIASED_NOTE)
    size = os.stat(output).st_size
    return DecompressResult(scene_info(scene), os.fspath(output), size, run_info(budget, clock), notes)
