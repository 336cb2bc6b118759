"""The measured error of removing a Gaussian against removing it and rendering again, across the whole range of errors.

Once with kernels whose pixels never end (then the measure is exact), once with the ordinary ones (then removing a Gaussian lets
splats be blended that lay behind the end, which frozen hits leave out).

python -m benchmarks.removal_exactness [--scene fox|sample] [--device SPEC] [--gaussians N] [--views N]
"""

from __future__ import annotations

import argparse
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import SCENES, Bench, check
from flexgs_edge.budget import MemoryBudget
from flexgs_edge.cameras import Camera, read_cameras, split_views
from flexgs_edge.constants import FIXED_ERROR
from flexgs_edge.kernels import open_backend
from flexgs_edge.kernels.source import KERNEL_DIR_VARIABLE, kernel_dir
from flexgs_edge.progress import Progress
from flexgs_edge.render import DeviceScene, Renderer
from flexgs_edge.scene.ply import PlySource
from flexgs_edge.score.removal import measure_costs

PIXEL_NOISE = 2e-7
"""Rounding of a float32 render: its difference from the image without one Gaussian is off by about so much in every value."""
HIDDEN = np.float32(-1e3)
"""log2 of an opacity that no view shows."""
FIRST_LINE = "#pragma OPENCL FP_CONTRACT OFF\n"


@dataclass(frozen=True)
class Exactness:
    """Errors of removing single rows, summed over views.

    Parameters
    ----------
    measured, rendered : np.ndarray
        [m] f64: from one scoring pass, and from images with and without the Gaussian.
    noise : np.ndarray
        [m] f64: what rounding of the images explains of their difference.
    """

    measured: np.ndarray
    rendered: np.ndarray
    noise: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """[m] relative difference."""
        return abs(self.measured - self.rendered) / np.maximum(self.rendered, 1e-30)

    @property
    def beyond_noise(self) -> np.ndarray:
        """[m] relative difference that rounding does not explain."""
        difference = np.maximum(abs(self.measured - self.rendered) - self.noise, 0)
        return difference / np.maximum(self.rendered, 1e-30)


def kernels_without_ending(folder: Path) -> Path:
    """A copy of the kernels whose pixels never end: the least transmittance is zero."""
    shutil.copytree(kernel_dir(), folder)
    common = folder / "common.clh"
    text = common.read_text(encoding="utf-8")
    check(FIRST_LINE in text, f"{FIRST_LINE.strip()} in common.clh")
    changed = f"{FIRST_LINE}#undef TRANSMITTANCE_MIN\n#define TRANSMITTANCE_MIN 0.0f\n"
    common.write_text(text.replace(FIRST_LINE, changed), encoding="utf-8")
    return folder


def spread_over_range(costs: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
    """[count] rows drawn evenly over the logarithm of their costs, from the least above zero to the largest."""
    rng = np.random.default_rng(seed)
    order = np.argsort(costs, kind="stable")
    order = order[costs[order] > 0]
    logs = np.log(costs[order])
    edges = np.linspace(logs[0], logs[-1], count + 1)
    edges[0] -= 1
    rows: list[int] = []
    for low, high in zip(edges, edges[1:]):
        inside = order[np.searchsorted(logs, low, "right") : np.searchsorted(logs, high, "right")]
        rows += rng.choice(inside, 1).tolist() if len(inside) else []
    # Where the range has gaps, the rest comes from anywhere.
    left = np.setdiff1d(order, rows)
    rows += rng.choice(left, min(count - len(rows), len(left)), replace=False).tolist()
    return np.sort(np.array(rows, np.int64))


@contextmanager
def without(scene: DeviceScene, row: int) -> Iterator[None]:
    """The scene without one row, for as long as the block lasts (it must be resident)."""
    check(scene.resident, "a scene that fits into memory")
    chunk = next(chunk for chunk in scene.chunks() if chunk.base <= row < chunk.base + chunk.count)
    before = scene.backend.read(chunk.log2_opacity, np.empty(1, np.float32), row - chunk.base)
    scene.backend.write(chunk.log2_opacity, np.full(1, HIDDEN), row - chunk.base)
    try:
        yield
    finally:
        scene.backend.write(chunk.log2_opacity, before, row - chunk.base)


def compare_with_renders(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[Camera],
    rows: np.ndarray,
    progress: Progress | None = None,
) -> Exactness:
    """Remove each of `rows` alone and render every view that shows it again."""
    measured, rendered, noise = (np.zeros(len(rows)) for _ in range(3))
    progress = progress or Progress(enabled=False)
    for camera in progress.track(cameras, "removing and rendering", len(cameras)):
        sums = renderer.read_sums(renderer.removal_sums(scene, camera), 2, scene.count)[0][rows] / FIXED_ERROR
        measured += sums
        whole = renderer.render(scene, camera).astype(np.float64)
        for place in np.flatnonzero(sums):
            with without(scene, int(rows[place])):
                difference = abs(renderer.render(scene, camera) - whole)
            rendered[place] += float(np.vdot(difference, difference))
            # The square of (difference + rounding), with every rounding of one sign: a bound.
            touched = difference[difference > 0]
            noise[place] += float(2 * PIXEL_NOISE * touched.sum() + touched.size * PIXEL_NOISE**2)
    return Exactness(measured, rendered, noise)


def report(bench: Bench, name: str, found: Exactness) -> None:
    """Relative differences by size of the error, and the share beyond 1 %."""
    exponents = np.floor(np.log10(np.maximum(found.measured, 1e-30))).astype(int)
    for exponent in np.unique(exponents // 2):
        inside = exponents // 2 == exponent
        label = f"{name}: error 1e{2 * exponent} to 1e{2 * exponent + 2}"
        beyond = f"beyond rounding at most {found.beyond_noise[inside].max():.1e}"
        bench.add(label, found.relative[inside].tolist(), "relative", beyond)
    for limit in (1e-4, 1e-2):
        share = float((found.beyond_noise > limit).mean())
        bench.add(f"{name}: off by more than {limit:g}", [share], "share", f"{len(found.measured)} Gaussians")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="fox", help="default: %(default)s")
    parser.add_argument("--device", help="as for flexgs-edge; default: the device that it would take")
    parser.add_argument("--gaussians", type=int, default=200, help="default: %(default)s")
    parser.add_argument("--views", type=int, help="most training poses, evenly spread; default: all")
    options = parser.parse_args()
    folder = SCENES[options.scene]
    source, cameras = PlySource(folder / "point_cloud.ply"), read_cameras(folder / "cameras.json")
    train, _ = split_views(len(cameras))
    views = min(options.views or len(train), len(train))
    poses = [cameras[train[i * len(train) // views]] for i in range(views)]
    rows: np.ndarray | None = None
    with tempfile.TemporaryDirectory() as scratch:
        for name in ("ending on", "ending off"):
            if name == "ending off":
                os.environ[KERNEL_DIR_VARIABLE] = str(kernels_without_ending(Path(scratch) / "kernels"))
            budget = MemoryBudget.from_limit(None)
            backend = open_backend(options.device, budget)
            renderer = Renderer(backend, budget)
            with renderer.load(source) as scene:
                if rows is None:
                    rows = spread_over_range(measure_costs(renderer, scene, poses, False).removal, options.gaussians)
                found = compare_with_renders(renderer, scene, poses, rows, Progress())
            renderer.release()
            report(Bench(backend.name, 1), name, found)
            print(
                f"{name}: total measured / rendered {found.measured.sum() / found.rendered.sum():.6f}", file=sys.stderr
            )
            backend.close()
    check(bool((found.beyond_noise <= 1e-4).all()), "exact with early ending off")


if __name__ == "__main__":
    main()
