"""`synth`: make a large scene from a small one, to test memory and time. Rows are written as they are made."""

from __future__ import annotations

import logging
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.inria import inria_json
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.decompress import ANTIALIASED_NOTE
from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, check_writable
from flexgs_edge.io.ply import inria_dtype, write_ply
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.report.file_results import SynthResult
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.companions import companions_of
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.spent import run_info
from flexgs_edge.scene.parts import MOST_PARTS, PartsSource
from flexgs_edge.scene.source import SceneSource

LOG = logging.getLogger("flexgs_edge")

ROW_COPIES = 3
"""Copies of a PLY row in memory while rows are made and written: the parent's values, planes, the table."""
WORK_BYTES = 800
"""Bytes per row besides: means, scales, rotations and their products in float64, and row numbers."""
CHUNK_ROWS = 16384
"""We make at most this many rows at a time. More is slower, because the float64 planes no longer fit the cache."""
_SAMPLE_ROWS = 65536
_CORE = (0.01, 0.99)
"""A tile spans the positions between these quantiles. The far background of a scene overlaps its neighbours."""
_GAP = 1.05
"""Distance between tiles, in widths of a tile."""


def synth(
    output: str | Path,
    input: str | Path,
    gaussians: int,
    seed: int = 0,
    force: bool = False,
    memory_limit: int | None = None,
) -> SynthResult:
    """Write a scene of `gaussians` Gaussians made from a smaller one, and cameras for it.

    Up to `MOST_PARTS` times the scene's count, each Gaussian is split into parts that look like it together. Beyond that,
    copies of the scene (tiles) stand side by side. Memory does not grow with `gaussians`. The same scene, `gaussians` and
    `seed` give the same bytes.

    Parameters
    ----------
    output : path
        The `.ply` to write. If the scene has cameras, `cameras.json` is written beside it.
    input : path
        A scene file or a model folder.
    gaussians : int
        Number of Gaussians to write, at least as many as the scene has.
    seed : int
        Chooses the Gaussians that get one part more than others.
    force : bool
        Overwrite existing files.
    memory_limit : int, optional
        Bytes for the whole process. Default: three quarters of the free memory.

    Returns
    -------
    SynthResult
        Counts, tiles, parts and cameras of the new scene.

    Raises
    ------
    InputError
        If the scene has more Gaussians than asked for, or a file exists already.
    BudgetError
        If the memory limit is too small for any chunk, or the disk is full.
    """
    if Path(output).suffix.lower() != ".ply" or str(output).lower().endswith(".compressed.ply"):
        raise InputError(f"{output}: expected a name that ends in .ply (and not in .compressed.ply)")
    if seed < 0:
        raise InputError(f"--seed {seed}: expected 0 or more")
    target = check_writable(output, force)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(memory_limit)
    with clock.stage("open"):
        companions = companions_of(input)
        scene = load_scene(input)
        source = scene.source
        if not source.count <= gaussians < 2**31:
            raise InputError(
                f"--gaussians {gaussians}: expected at least the {source.count} of {input}, and less than {2**31}; "
                "to make a scene smaller, use compress"
            )
        tiles = -(-gaussians // (MOST_PARTS * source.count))
        shifts = tile_shifts(source, tiles)
        made = PartsSource(source, gaussians, shifts, seed)
        notes: tuple[str, ...] = ()
        cameras: list[Camera] = []
        if companions.cameras is not None:
            cameras = read_cameras(companions.cameras, ignore_distortion=True)
            notes = _camera_notes(cameras)
            cameras = tiled_cameras(cameras, shifts)
        beside = target.with_name("cameras.json")
        if cameras and companions.cameras is not None:
            _check_cameras(beside, companions.cameras, force)
        row = ROW_COPIES * inria_dtype(source.sh_degree).itemsize + WORK_BYTES
        rows = budget.rows("making Gaussians", row, minimum=min(gaussians, 1024), most=CHUNK_ROWS)
    with clock.stage("write"):
        LOG.info("writing %d Gaussians, %d at a time", gaussians, rows)
        if cameras:
            # The file of cameras gets its name only after the scene has got its own.
            with atomic_write(beside, force) as file:
                file.write(inria_json(cameras).encode())
                notes = (*write_ply(target, made, force=force, chunk_rows=rows), *notes)
        else:
            notes = (*write_ply(target, made, force=force, chunk_rows=rows), *notes)
    if scene.settings.get("antialiased") is True:
        notes = (*notes, ANTIALIASED_NOTE)
    return SynthResult(
        input=os.fspath(input),
        input_count=source.count,
        sh_degree=source.sh_degree,
        output=os.fspath(output),
        count=gaussians,
        size=os.stat(target).st_size,
        seed=seed,
        tiles=tiles,
        parts=(gaussians // (tiles * source.count), -(-gaussians // (tiles * source.count))),
        cameras=os.fspath(beside) if cameras else None,
        views=len(cameras),
        notes=(*source.notes, *notes),
        run=run_info(budget, clock),
    )


def tile_shifts(source: SceneSource, tiles: int) -> np.ndarray:
    """Offsets of the copies of a scene: [tiles, 3] f64, scene units. The first is zero.

    The copies fill a nearly square grid in the plane of the scene's two widest axes.
    """
    shifts = np.zeros((tiles, 3))
    if tiles == 1:
        return shifts
    step = -(-source.count // _SAMPLE_ROWS)
    sample = source.read(np.arange(0, source.count, step), ["means"])["means"].astype(np.float64)
    low, high = np.quantile(sample, _CORE, axis=1)
    width = high - low
    axes = np.sort(np.argsort(-width, kind="stable")[:2])
    # A point or a line has no width: without this its copies would all stand in one place.
    pitch = _GAP * np.where(width[axes] > 0, width[axes], max(width.max(), 1.0))
    columns = int(np.ceil(np.sqrt(tiles)))
    number = np.arange(tiles)
    shifts[:, axes[0]] = number % columns * pitch[0]
    shifts[:, axes[1]] = number // columns * pitch[1]
    return shifts


def tiled_cameras(cameras: list[Camera], shifts: np.ndarray) -> list[Camera]:
    """Spread cameras over tiles: each camera moves to the next tile in turn.

    One tile keeps its cameras. More tiles get as many cameras as there are cameras or tiles, whichever is more. Every tile is
    then seen from inside, and a pass over all views costs little more than with one tile.
    """
    if len(shifts) == 1:
        return cameras
    views = []
    for number in range(max(len(cameras), len(shifts))):
        camera, tile = cameras[number % len(cameras)], number % len(shifts)
        name = f"tile_{tile:05d}_{number // len(shifts):05d}_{camera.name}"
        views.append(replace(camera.moved(-shifts[tile]), name=name))
    return views


def _camera_notes(cameras: list[Camera]) -> tuple[str, ...]:
    """Notes on properties of these cameras that INRIA's cameras.json cannot hold."""
    notes = []
    if any(camera.distortion is not None for camera in cameras):
        notes.append("lens distortion left out of cameras.json: only poses and focal lengths are kept")
    off = max(max(abs(c.cx - (c.width - 1) / 2), abs(c.cy - (c.height - 1) / 2)) for c in cameras)
    if off > 0.5:
        notes.append(f"principal points up to {off:.1f} pixels off the middle left out of cameras.json, which has none")
    return tuple(notes)


def _check_cameras(beside: Path, cameras: Path, force: bool) -> None:
    if beside.exists() and cameras.exists() and beside.samefile(cameras):
        raise InputError(f"{beside}: these are the scene's own cameras, and would be replaced: write to another folder")
    check_writable(beside, force)
