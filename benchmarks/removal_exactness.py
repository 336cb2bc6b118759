"""Compares the measured cost of removing a Gaussian with removing it and blending again in float64.

It runs twice. With kernels whose pixels never end, measured costs are exact. With the ordinary kernels, removing a Gaussian
reveals splats behind the end of a pixel, and measured costs leave these out. Projection and tile lists are the renderer's.
The comparison needs float64: where costs are small, the change of the image is below the rounding of float32.

python -m benchmarks.removal_exactness [--scene fox|sample] [--device SPEC] [--gaussians N] [--views N]
"""

from __future__ import annotations

import argparse
import os
import shutil
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.harness import SCENES, Timer, check, read_sums
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.constants import ALPHA_MAX, ALPHA_MIN, FIXED_ERROR, TILE, TRANSMITTANCE_MIN
from flexgs_edge.io.ply import PlySource
from flexgs_edge.kernels.cl_sources import KERNEL_DIR_VARIABLE, kernel_dir
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.progress import Progress
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer

ROUNDING = 2.0**-22
"""Rounding error of a pixel's change by a removal, divided by alpha / (1 - alpha). Float32 rounds the light from behind a few
times, and its colours add up to about 1."""
NEAR_THRESHOLD = 1e-4
"""Splats whose alpha is this near (relative) to the least drawn alpha may be drawn in float32 and not in float64."""
FLOORS = tuple(10.0**exponent for exponent in range(-8, 1))
"""Squared errors among which the smallest exact one is searched for."""
FIRST_LINE = "#pragma OPENCL FP_CONTRACT OFF\n"


@dataclass(frozen=True)
class Exactness:
    """Squared errors of removing single rows, summed over views.

    Parameters
    ----------
    measured, rendered : np.ndarray
        [m] f64, from one scoring pass, and from pixels blended with and without the Gaussian.
    noise : np.ndarray
        [m] f64, about the largest change by rounding to float32 and to fixed point.
    """

    measured: np.ndarray
    rendered: np.ndarray
    noise: np.ndarray

    @property
    def relative(self) -> np.ndarray:
        """[m] f64, relative difference."""
        return abs(self.measured - self.rendered) / np.maximum(self.rendered, 1e-30)

    @property
    def beyond_noise(self) -> np.ndarray:
        """[m] f64, relative difference that rounding does not explain."""
        return np.maximum(abs(self.measured - self.rendered) - self.noise, 0) / np.maximum(self.rendered, 1e-30)

    def floor(self, limit: float) -> float:
        """The smallest error above which no relative difference exceeds `limit`."""
        return next((f for f in FLOORS if (self.relative[self.rendered > f] <= limit).all()), float("inf"))


def kernels_without_ending(folder: Path) -> Path:
    """A copy of the kernels whose pixels never end, because the least transmittance is zero."""
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
    # If the range has gaps, the rest comes from anywhere.
    left = np.setdiff1d(order, rows)
    rows += rng.choice(left, min(count - len(rows), len(left)), replace=False).tolist()
    return np.sort(np.array(rows, np.int64))


class BlendedView:
    """Pixels of the view that a renderer drew last, blended again in float64 from its splats and tile lists.

    Parameters
    ----------
    renderer : Renderer
        Has just drawn the view, in one batch.
    camera : Camera
        The view.
    least : float
        Transmittance that ends a pixel.
    """

    def __init__(self, renderer: Renderer, camera: Camera, least: float) -> None:
        buffers, backend = renderer._buffers, renderer.backend
        assert buffers is not None
        self.records = backend.read(buffers.records)[:, :9]
        pairs, ends = backend.read(buffers.pairs), backend.read(buffers.ends)
        self.ends = ends[(backend.tile_blocks - 1) * buffers.size.tiles :][: buffers.size.tiles].astype(np.int64)
        self.ids = pairs[: self.ends[-1], 0]
        self.tiles_x, self.camera, self.least = buffers.size.tiles_x, camera, least
        self.background = np.array(renderer.background)
        # Pairs sorted by splat give the tiles of every splat.
        tile_of = np.repeat(np.arange(buffers.size.tiles), np.diff(self.ends, prepend=0))
        order = np.argsort(self.ids, kind="stable")
        self.by_splat, self.tiles_by_splat = self.ids[order], tile_of[order]

    def removal(self, row: int) -> np.ndarray:
        """[2] f64, squared error of the view without the splat `row`, and its change by rounding."""
        first, last = np.searchsorted(self.by_splat, [row, row + 1])
        return sum((self._tile(int(tile), row) for tile in self.tiles_by_splat[first:last]), np.zeros(2))

    def _tile(self, tile: int, row: int) -> np.ndarray:
        ids = self.ids[self.ends[tile - 1] if tile else 0 : self.ends[tile]]
        x0, y0 = TILE * (tile % self.tiles_x), TILE * (tile // self.tiles_x)
        ys, xs = np.mgrid[y0 : min(y0 + TILE, self.camera.height), x0 : min(x0 + TILE, self.camera.width)]
        mx, my, qa, qb, qc, level, *colours = self.records[ids].T[:, :, None].astype(np.float64)
        at = int(np.flatnonzero(ids == row)[0])

        def alphas(rows: slice, x: np.ndarray, y: np.ndarray) -> np.ndarray:
            dx, dy = x - mx[rows], y - my[rows]
            power = np.maximum((qa[rows] * dx + qb[rows] * dy) * dx + qc[rows] * dy * dy, 0.0)
            alpha: np.ndarray = np.exp2(level[rows] - power)
            return alpha

        # Other pixels cannot change. Small splats reach only a few pixels of a tile.
        x, y = xs.reshape(-1), ys.reshape(-1)
        reached = np.flatnonzero(alphas(slice(at, at + 1), x, y)[0] >= ALPHA_MIN * (1 - NEAR_THRESHOLD))
        alpha = alphas(slice(None), x[reached], y[reached])
        near = abs(alpha / ALPHA_MIN - 1) < NEAR_THRESHOLD
        alpha = np.where(alpha >= ALPHA_MIN, np.minimum(alpha, ALPHA_MAX), 0.0)
        whole = self._blend(alpha, colours)
        own, flips = alpha[at].copy(), near[at].copy()
        alpha[at] = 0.0
        difference = self._blend(alpha, colours) - whole
        rounding = ROUNDING * own / (1 - own)
        noise = 2 * (abs(difference).sum(axis=0) * rounding).sum() + 3 * np.vdot(rounding, rounding) + 1 / FIXED_ERROR
        # One splat more or less in front or behind changes this one's part by 2 ALPHA_MIN of it; this splat itself, by all.
        square = (difference * difference).sum(axis=0)
        flipped = np.where(flips, np.maximum(square, 3 * ALPHA_MIN**2), 4 * ALPHA_MIN * near.any(axis=0) * square)
        return np.array([square.sum(), noise + flipped.sum()])

    def _blend(self, alpha: np.ndarray, colours: list[np.ndarray]) -> np.ndarray:
        after = np.cumprod(1.0 - alpha, axis=0)
        hit = after >= self.least  # transmittance only falls
        before = np.concatenate([np.ones((1, alpha.shape[1])), after[:-1]])
        weight = np.where(hit, alpha * before, 0.0)
        end = np.where(hit, after, np.inf).min(axis=0, initial=1.0)
        return np.stack([(weight * c).sum(axis=0) + end * b for c, b in zip(colours, self.background, strict=True)])


def compare_in_float64(
    renderer: Renderer,
    scene: DeviceScene,
    cameras: Sequence[Camera],
    rows: np.ndarray,
    least: float = TRANSMITTANCE_MIN,
    progress: Progress | None = None,
) -> Exactness:
    """Remove each of `rows` alone, and blend the tiles that it touches again."""
    measured, blended = np.zeros(len(rows)), np.zeros((len(rows), 2))
    progress = progress or Progress(enabled=False)
    for camera in progress.track(cameras, "removing and blending", len(cameras)):
        sums = read_sums(renderer, renderer.removal_sums(scene, camera), 2, scene.count)[0]
        measured += sums[rows] / FIXED_ERROR
        view = BlendedView(renderer, camera, least)
        blended += [view.removal(int(row)) for row in rows]
    return Exactness(measured, *blended.T)


def report(timer: Timer, name: str, found: Exactness) -> None:
    """Report relative differences by size of the error, and the shares beyond 1e-4 and 1 %."""
    exponents = np.floor(np.log10(np.maximum(found.rendered, 1e-16)) / 2).astype(int)
    for exponent in np.unique(exponents):
        relative = found.relative[exponents == exponent]
        label = f"{name}: error 1e{2 * exponent} to 1e{2 * exponent + 2}"
        timer.add(label, relative.tolist(), "relative", f"off by more than 1 %: {(relative > 0.01).sum()}")
    for limit in (1e-4, 1e-2):
        for what, shown in (("off", found.relative), ("off, beyond what rounding explains,", found.beyond_noise)):
            note = f"{(shown > limit).sum()} of {len(shown)} Gaussians"
            timer.add(f"{name}: {what} by more than {limit:g}", [float((shown > limit).mean())], "share", note)
    off = found.relative > 1e-4
    largest = abs(found.measured - found.rendered)[off].max(initial=0.0)
    above = f"{(found.rendered > found.floor(1e-4)).sum()} of {len(off)} Gaussians are above"
    timer.add(f"{name}: least error above which all are within 1e-4", [found.floor(1e-4)], "squared error", above)
    timer.add(f"{name}: largest difference of those that are not", [float(largest)], "squared error", f"{off.sum()}")
    timer.add(f"{name}: total measured / blended again", [found.measured.sum() / found.rendered.sum()], "ratio")


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
                least = 0.0 if name == "ending off" else TRANSMITTANCE_MIN
                found = compare_in_float64(renderer, scene, poses, rows, least, Progress())
            renderer.release()
            report(Timer(backend.name, 1), name, found)
            backend.close()
    worst = float(found.beyond_noise.max())
    check(worst <= 1e-4, f"exact with early ending off but for rounding, got a difference of {worst:.2g}")


if __name__ == "__main__":
    main()
