"""`decompress`: a scene to a PLY that every viewer opens, or to another program's format."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from flexgs_edge.budget import MemoryBudget
from flexgs_edge.codec import GridSource
from flexgs_edge.codec.coder import CHUNK_ROWS
from flexgs_edge.errors import InputError
from flexgs_edge.formats import FORMATS, check_converter, converter_bytes, format_of, write_foreign
from flexgs_edge.kernels import Backend
from flexgs_edge.pipeline.inputs import load_scene
from flexgs_edge.pipeline.records import scene_info
from flexgs_edge.pipeline.workspace import DEVICE_ROWS, Stopwatch, counted_backend, run_info
from flexgs_edge.render import Renderer
from flexgs_edge.report.result import DecompressResult
from flexgs_edge.scene import MemorySource, SceneSource, check_writable, inria_dtype, write_ply
from flexgs_edge.scene.source import read_all

WRITE_COPIES = 3
"""Times a chunk's rows that decoding and writing hold at once: codes, planes, rows of the PLY."""
DECODE_BYTES = 800
"""Bytes a row that decoding a chunk holds: codes, features, neighbours' weights, sums."""

ANTIALIASED_NOTE = "an antialiased model: the file does not say so; viewers must be told, and here --antialiased"


def decoder(device: str | None, source: SceneSource, budget: MemoryBudget, clock: Stopwatch) -> Backend | None:
    """The device that decodes a scene; None: NumPy does, with the same results.

    That is so for files that are not of container version 2, with `device` "numpy", on GPUs (a work-item decodes a chunk: theirs
    would crawl), and, unless a device is named, for scenes too small to make up for opening one, and where no processor has a
    driver that works.

    Raises
    ------
    DeviceError
        When the device that is named does not exist or failed its self-test.
    """
    if device == "numpy" or not isinstance(source, GridSource):
        return None
    if device is None:
        if source.count < DEVICE_ROWS:
            return None
        from flexgs_edge.device.select import list_devices

        if not any(found.type == "cpu" and found.usable for found in list_devices()):
            return None
        device = "cpu"
    backend = counted_backend(device, budget, clock)
    return backend if backend.threads else None


@contextmanager
def ahead(source: SceneSource, budget: MemoryBudget, backend: Backend | None = None) -> Iterator[None]:
    """Decoding of the next chunks while one is written, where memory allows."""
    if not isinstance(source, GridSource):
        yield
        return
    most = 0 if backend is None else min(backend.threads, source.threads)
    at_once = max((n for n in range(1, most + 1) if source.device_bytes(n) <= budget.free), default=0)
    if backend is not None and at_once:
        with source.on_device(backend, at_once), source.whole_in_order(at_once):
            yield
        return
    threads = source.threads
    chunk = min(source.count, CHUNK_ROWS) * DECODE_BYTES
    while threads > 1 and budget.free < (threads + 1) * chunk:
        threads -= 1
    with source.whole_in_order(threads):
        yield


def decoded(source: SceneSource, renderer: Renderer) -> SceneSource:
    """A file's scene for a renderer that draws several views of it: decoded once, to scratch files, where scenes lie there.

    Otherwise it is the source as it is, which views in memory read once. Views give their memory to the decoder.
    """
    room, budget = renderer.room, renderer.budget
    if not room.spills:
        return source
    renderer.release()
    budget.require("decoding the file", min(source.count, CHUNK_ROWS) * DECODE_BYTES)
    with ahead(source, budget):
        planes = read_all(source, room)
    return MemorySource(planes, source.sh_degree, source.origin, source.name)


def decompress(
    input: str | Path,
    output: str | Path,
    force: bool = False,
    memory_limit: int | None = None,
    device: str | None = None,
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
    device : str, optional
        What decodes: see `decoder`.
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
    backend = None
    if format is None:
        backend = decoder(device, scene.source, budget, clock)
    with clock.stage("write"):
        if format is not None:
            budget.require("the converter", converter_bytes(format, scene.source.count))
            notes = write_foreign(output, scene.source, force=force)
        else:
            row = inria_dtype(scene.source.sh_degree).itemsize
            rows = budget.rows("decoding", WRITE_COPIES * row, minimum=min(scene.source.count, 1024), most=65536)
            with ahead(scene.source, budget, backend):
                notes = write_ply(output, scene.source, force=force, chunk_rows=rows)
        if scene.settings.get("antialiased") is True:
            notes = (*notes, ANTIALIASED_NOTE)
    size = os.stat(output).st_size
    return DecompressResult(scene_info(scene), os.fspath(output), size, run_info(budget, clock, backend), notes)
