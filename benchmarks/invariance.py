"""Checks that compression does not depend on the unit and axes of the world: compares a scene with a scaled, turned copy.

`--method best` chooses by squared errors of pixels. So both runs should keep the same Gaussians in about as many bytes. Only
--near has a unit; it follows the scale.

python -m benchmarks.invariance [SCENE] [--factor F] [--effort fast|balanced|max] [--max-drop DB] [--resolution WIDTH]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.camera_files import inria_json
from benchmarks.harness import SCENES, Timer, check
from benchmarks.moved_scene import Similarity
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.compress import compress
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.methods.best.grid_coder import GridCoder
from flexgs_edge.methods.best.grid_maker import GridMaker
from flexgs_edge.methods.best.method import grid_maker
from flexgs_edge.methods.best.search import Candidate
from flexgs_edge.progress import Progress
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.run import Run
from flexgs_edge.scene.source import SceneSource

LEAST_SAME, MOST_BYTES = 0.99, 0.02
"""Least share of equal kept Gaussians, and largest relative difference of the bytes."""


def write_project(folder: Path, source: SceneSource, cameras: Sequence[Camera], images: Path | None) -> Path:
    """Write a PLY with cameras.json and linked photos beside it."""
    folder.mkdir()
    write_ply(folder / "point_cloud.ply", source, double=bool(source.origin.any()))
    (folder / "cameras.json").write_text(inria_json(cameras), encoding="utf-8")
    if images is not None:
        (folder / "images").symlink_to(images.resolve(), target_is_directory=True)
    return folder / "point_cloud.ply"


@dataclass(frozen=True, eq=False)
class Found:
    """Answer of a search: the multiplier, the kept rows (ascending), and the bytes of the file."""

    maker: GridMaker
    multiplier: float
    rows: np.ndarray
    size: int


def compress_and_look(path: Path, output: Path, near: float, progress: Progress, **words: Any) -> Found:
    """Compress by `--method best`; returns the kept rows and the bytes of the file."""
    makers: list[GridMaker] = []
    steps: list[Candidate] = []

    class Recorded(GridMaker):
        def _measured(self, *given: Any) -> Any:
            found = super()._measured(*given)
            steps.append(found[0])
            return found

    def recording(run: Run[CompressOptions], coder: GridCoder) -> Any:
        make = grid_maker(run, coder)

        def recorded(*given: Any) -> Any:
            maker = make(*given)
            assert isinstance(maker, GridMaker)
            makers.append(maker)
            return maker

        return recorded

    made = "flexgs_edge.methods.best.method"
    with mock.patch(f"{made}.grid_maker", recording), mock.patch(f"{made}.GridMaker", Recorded):
        result = compress(path, output, method="best", near=near, force=True, progress=progress, **words)
    assert result.search is not None
    chosen = next(step for step in steps if step.measurement == result.search.chosen.measurement)
    rows = np.sort(makers[0].rounds.rows[makers[0].selection.kept(chosen.multiplier).rows])
    # A search trims a few of them.
    check(0.8 * len(rows) < result.count <= len(rows), "the rows of the file")
    return Found(makers[0], chosen.multiplier, np.sort(rows), result.size)


@dataclass(frozen=True)
class Likeness:
    """Comparison of two compressions: the share of rows that both keep, and the second's bytes over the first's.

    `choice` is the share at the first one's multiplier, so it shows how far the choice itself differs. Where the searches
    stop is partly chance, because rounding moves the drop of a candidate.
    """

    same: float
    bytes_ratio: float
    choice: float


def compare(
    folder: Path, scratch: Path, factor: float, progress: Progress | None = None, **words: Any
) -> tuple[Likeness, str]:
    """Compress the scene of `folder` as it is, and scaled and turned.

    Parameters
    ----------
    folder : path
        Folder with point_cloud.ply, cameras.json, and images/ if there are photos.
    scratch : path
        Folder for the moved scene and both files.
    **words
        Options of `compress`.
    """
    progress = progress or Progress(enabled=False)
    source, cameras = PlySource(folder / "point_cloud.ply"), read_cameras(folder / "cameras.json")
    move = Similarity.drawn(factor)
    images = folder / "images"
    moved = write_project(
        scratch / "moved", move.scene(source), [move.camera(c) for c in cameras], images if images.is_dir() else None
    )
    first = compress_and_look(source.path, scratch / "first.fgs", DEFAULT_NEAR, progress, **words)
    second = compress_and_look(moved, scratch / "second.fgs", DEFAULT_NEAR * factor, progress, **words)
    choice = np.sort(second.maker.rounds.rows[second.maker.selection.kept(first.multiplier).rows])
    note = f"{len(first.rows)} and {len(second.rows)} Gaussians, {first.size} and {second.size} bytes"
    return Likeness(_same(first.rows, second.rows), second.size / first.size, _same(first.rows, choice)), note


def _same(first: np.ndarray, second: np.ndarray) -> float:
    """Share of rows that are in both lists, of the longer list."""
    return len(np.intersect1d(first, second)) / max(len(first), len(second), 1)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", nargs="?", choices=SCENES, default="fox", help="default: %(default)s")
    parser.add_argument("--factor", type=float, default=100.0, help="default: %(default)s")
    parser.add_argument("--effort", default="fast", help="default: %(default)s")
    parser.add_argument("--max-drop", type=float, default=1.0, metavar="DB", help="default: %(default)s")
    parser.add_argument("--resolution", type=int, help="widest view, pixels; default: as the cameras are")
    parser.add_argument("--device", help="as for flexgs-edge; default: the device that it would take")
    options = parser.parse_args()
    words = {"effort": options.effort, "max_drop": options.max_drop, "device": options.device}
    if options.resolution:
        words["resolution"] = options.resolution
    with tempfile.TemporaryDirectory() as scratch:
        found, note = compare(SCENES[options.scene], Path(scratch), options.factor, Progress(), **words)
    timer = Timer(options.device or "default", 1)
    timer.add(f"scaled {options.factor:g}x and turned: kept Gaussians that are the same", [found.same], "share", note)
    timer.add(f"scaled {options.factor:g}x and turned: the same at one multiplier", [found.choice], "share", note)
    timer.add(f"scaled {options.factor:g}x and turned: bytes", [found.bytes_ratio], "ratio", note)
    check(found.same >= LEAST_SAME and abs(found.bytes_ratio - 1) <= MOST_BYTES, "the same Gaussians and bytes")


if __name__ == "__main__":
    main()
