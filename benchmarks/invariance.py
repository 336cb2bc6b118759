"""The same compression whatever the unit and the axes of the world: a scene as it is, and scaled and turned.

`--method best` chooses by squared errors of pixels, so both shall keep the same Gaussians in as many bytes. Only --near has a
unit, and follows the scale.

python -m benchmarks.invariance [SCENE] [--factor F] [--effort fast|balanced|thorough] [--max-drop DB] [--resolution WIDTH]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks.harness import SCENES, Bench, check
from flexgs_edge.best.search import RateSearch, RateStep
from flexgs_edge.cameras import Camera, read_cameras
from flexgs_edge.cameras.inria import inria_json
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.kernels.twins.project import sh_basis
from flexgs_edge.pipeline.best import GridCoder, grid_search
from flexgs_edge.pipeline.compress import compress
from flexgs_edge.pipeline.options import CompressOptions
from flexgs_edge.progress import Progress
from flexgs_edge.scene import write_ply
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.ply import PlySource
from flexgs_edge.scene.source import MemorySource, SceneSource

LEAST_SAME, MOST_BYTES = 0.99, 0.02
"""Share of the kept Gaussians that must be the same, and difference of the bytes that is allowed."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """x' = factor * turn @ x + shift.

    Parameters
    ----------
    factor : float
    turn : np.ndarray
        [4] f64, unit quaternion w x y z.
    shift : np.ndarray
        [3] f64.
    """

    factor: float
    turn: np.ndarray
    shift: np.ndarray

    @classmethod
    def drawn(cls, factor: float, seed: int = 0) -> Similarity:
        """With a turn and a shift (of about 3 units of the new scene) drawn at random."""
        rng = np.random.default_rng(seed)
        turn = rng.normal(size=4)
        return cls(factor, turn / np.linalg.norm(turn), 3 * factor * rng.normal(size=3))

    @property
    def matrix(self) -> np.ndarray:
        """[3, 3] f64: the rotation."""
        w, x, y, z = self.turn
        rows = [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
        return np.array(rows)

    def scene(self, source: SceneSource) -> MemorySource:
        """The scene moved: positions, sizes, rotations and the SH, which turn degree by degree."""
        planes = source.read(slice(0, source.count), list(FIELD))
        means = planes["means"].astype(np.float64) + source.origin[:, None]
        moved = {
            **planes,
            "means": self.factor * (self.matrix @ means),
            "log_scales": planes["log_scales"] + np.log(self.factor),
            "quats": _product(self.turn, planes["quats"].astype(np.float64)),
        }
        rest = planes["sh_rest"].reshape(3, sh_rest_count(source.sh_degree), source.count)
        turned = rest.astype(np.float64)
        for degree in range(1, source.sh_degree + 1):
            band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
            turned[:, band] = turn_of_band(self.matrix, degree) @ rest[:, band]
        moved["sh_rest"] = turned.reshape(planes["sh_rest"].shape)
        return MemorySource(
            {name: values.astype(np.float32) for name, values in moved.items()}, source.sh_degree, self.shift
        )

    def camera(self, camera: Camera) -> Camera:
        """The same view of the moved scene."""
        rotation = camera.rotation @ self.matrix.T
        return replace(camera, rotation=rotation, translation=self.factor * camera.translation - rotation @ self.shift)


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[4, n] Hamilton products of one quaternion ([4]) and many ([4, n])."""
    w, x, y, z = a
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    product: np.ndarray = matrix @ b
    return product


def turn_of_band(matrix: np.ndarray, degree: int) -> np.ndarray:
    """[2l + 1, 2l + 1] f64: SH coefficients of one degree after the world was turned by `matrix`.

    Fitted by least squares: a colour seen along d before is seen along `matrix @ d` after, and functions of one degree stay
    functions of that degree.
    """
    directions = np.random.default_rng(degree).normal(size=(3, 200))
    directions /= np.linalg.norm(directions, axis=0)
    band = slice(degree * degree - 1, (degree + 1) ** 2 - 1)
    before = np.array(sh_basis(degree, *directions)[band]).T
    after = np.array(sh_basis(degree, *(matrix @ directions))[band]).T
    fitted, *_ = np.linalg.lstsq(after, before, rcond=None)
    check(bool(np.abs(after @ fitted - before).max() < 1e-6), f"SH of degree {degree} turn into SH of that degree")
    result: np.ndarray = fitted
    return result


def write_project(folder: Path, source: SceneSource, cameras: Sequence[Camera], images: Path | None) -> Path:
    """A PLY with cameras.json and photos (linked) beside it."""
    folder.mkdir()
    write_ply(folder / "point_cloud.ply", source)
    (folder / "cameras.json").write_text(inria_json(cameras), encoding="utf-8")
    if images is not None:
        (folder / "images").symlink_to(images.resolve(), target_is_directory=True)
    return folder / "point_cloud.ply"


@dataclass(frozen=True, eq=False)
class Found:
    """A search's answer: the multiplier, the rows it keeps (ascending), and the bytes of the file."""

    search: RateSearch
    multiplier: float
    rows: np.ndarray
    size: int


def compress_and_look(path: Path, output: Path, near: float, progress: Progress, **words: Any) -> Found:
    """What `--method best` keeps, and the bytes of the file."""
    searches: list[RateSearch] = []
    steps: list[RateStep] = []

    def recording(options: CompressOptions, coder: GridCoder) -> Any:
        make = grid_search(options, coder)

        def recorded(path: Any, measure: Any, report: Any) -> Any:
            def noted(step: RateStep) -> None:
                steps.append(step)
                report(step)

            search = make(path, measure, noted)
            assert isinstance(search, RateSearch)
            searches.append(search)
            return search

        return recorded

    with mock.patch("flexgs_edge.pipeline.compress.grid_search", recording):
        result = compress(path, output, method="best", near=near, force=True, progress=progress, **words)
    assert result.search is not None
    chosen = steps[result.search.steps.index(result.search.chosen)]
    rows = searches[0].kept(chosen.multiplier).rows
    check(len(rows) == result.count, "the rows of the file")
    return Found(searches[0], chosen.multiplier, np.sort(rows), result.size)


@dataclass(frozen=True)
class Likeness:
    """Two compressions of one scene: the share of the kept rows that both keep, and the second's bytes over the first's.

    `choice` is the share at the first one's multiplier: how far the choice itself differs. The rest is where on the curve the
    searches stop. That is a matter of chance: rounding moves the drop of a whole result by 4 % (fox, one standard deviation).
    """

    same: float
    bytes_ratio: float
    choice: float


def compare(
    folder: Path, scratch: Path, factor: float, progress: Progress | None = None, **words: Any
) -> tuple[Likeness, str]:
    """Compress the scene of `folder` as it is and moved.

    Parameters
    ----------
    folder : path
        With point_cloud.ply, cameras.json, and images/ if there are photos.
    scratch : path
        Takes the moved scene and both files.
    **words
        For `compress`.
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
    choice = second.search.kept(first.multiplier).rows
    note = f"{len(first.rows)} and {len(second.rows)} Gaussians, {first.size} and {second.size} bytes"
    return Likeness(_same(first.rows, second.rows), second.size / first.size, _same(first.rows, choice)), note


def _same(first: np.ndarray, second: np.ndarray) -> float:
    """Rows in both, as a share of the longer list."""
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
    bench = Bench(options.device or "default", 1)
    bench.add(f"scaled {options.factor:g}x and turned: kept Gaussians that are the same", [found.same], "share", note)
    bench.add(f"scaled {options.factor:g}x and turned: the same at one multiplier", [found.choice], "share", note)
    bench.add(f"scaled {options.factor:g}x and turned: bytes", [found.bytes_ratio], "ratio", note)
    check(found.same >= LEAST_SAME and abs(found.bytes_ratio - 1) <= MOST_BYTES, "the same Gaussians and bytes")


if __name__ == "__main__":
    main()
