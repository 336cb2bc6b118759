"""`decompress`: a `.fgs` file back to a PLY that every viewer opens."""

from __future__ import annotations

import os
from pathlib import Path

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.errors import InputError
from flexgs_edge.pipeline.inputs import load_scene
from flexgs_edge.pipeline.records import scene_info
from flexgs_edge.pipeline.workspace import Stopwatch, run_info
from flexgs_edge.report.result import DecompressResult
from flexgs_edge.scene import check_writable, inria_dtype, write_ply

WRITE_COPIES = 3
"""Times a chunk's rows that decoding and writing hold at once: codes, planes, rows of the PLY."""

ANTIALIASED_NOTE = "an antialiased model: a PLY cannot say so; viewers must be told, and here --antialiased"


def decompress(
    input: str | Path, output: str | Path, force: bool = False, memory_limit: int | None = None
) -> DecompressResult:
    """Decode a scene to a PLY in INRIA's layout (little endian, zero normals), chunk by chunk.

    Parameters
    ----------
    input : path
        The `.fgs` file (a `.ply` or model folder works as well: it is rewritten in INRIA's layout).
    output : path
        The `.ply` to write.
    force : bool
        Overwrite `output` if it exists.
    memory_limit : int, optional
        Bytes for the whole process.
    """
    if Path(output).suffix.lower() != ".ply":
        raise InputError(f"-o {output}: expected a name that ends in .ply")
    check_writable(output, force)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(memory_limit)
    with clock.stage("open"):
        scene = load_scene(input)
    with clock.stage("write"):
        row = inria_dtype(scene.source.sh_degree).itemsize
        rows = budget.rows("decoding", WRITE_COPIES * row, minimum=min(scene.source.count, 1024), most=65536)
        notes = write_ply(output, scene.source, force=force, chunk_rows=rows)
        if scene.settings.get("antialiased") is True:
            notes = (*notes, ANTIALIASED_NOTE)
    size = os.stat(output).st_size
    return DecompressResult(scene_info(scene), os.fspath(output), size, run_info(budget, clock), notes)
