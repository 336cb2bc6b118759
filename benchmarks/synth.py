"""Makes a large scene from a small one, to test memory and time. Rows are written as they are made.

Up to `MOST_PARTS` times the scene's count, each Gaussian is split into parts that look like it together. Beyond that, copies of
the scene (tiles) stand side by side. The same scene, number and seed give the same bytes.

python -m benchmarks.synth OUT.ply --from SCENE --gaussians N [--seed N]
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.camera_files import inria_json
from benchmarks.parts import MOST_PARTS, PartsSource
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.run.inputs import companions_of, load_scene
from flexgs_edge.scene.source import SceneSource

CHUNK_ROWS = 16384
"""Rows that are made at a time. More is slower, because the float64 planes no longer fit the cache."""
_SAMPLE_ROWS = 65536
_CORE = (0.01, 0.99)
"""A tile spans the positions between these quantiles. The far background of a scene overlaps its neighbours."""
_GAP = 1.05
"""Distance between tiles, in widths of a tile."""


def synth(output: Path, input: Path, gaussians: int, seed: int = 0) -> int:
    """Write a scene of `gaussians` Gaussians, and its cameras.json beside it; returns the number of tiles."""
    source, cameras = load_scene(input).source, companions_of(input).cameras
    if not source.count <= gaussians < 2**31:
        raise InputError(f"--gaussians {gaussians}: expected at least the {source.count} of {input}, below {2**31}")
    shifts = tile_shifts(source, -(-gaussians // (MOST_PARTS * source.count)))
    write_ply(output, PartsSource(source, gaussians, shifts, seed), chunk_rows=CHUNK_ROWS)
    if cameras is not None:
        beside = output.with_name("cameras.json")
        if beside.exists():
            raise InputError(f"{beside}: the file exists: write to another folder")
        beside.write_text(inria_json(tiled_cameras(read_cameras(cameras, ignore_distortion=True), shifts)))
    return len(shifts)


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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path, metavar="OUT.ply")
    parser.add_argument("--from", dest="input", type=Path, required=True, metavar="SCENE")
    parser.add_argument("--gaussians", type=int, required=True, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N")
    options = parser.parse_args()
    tiles = synth(options.output, options.input, options.gaussians, options.seed)
    print(f"{options.output}: {options.gaussians} Gaussians in {tiles} tiles")


if __name__ == "__main__":
    main()
