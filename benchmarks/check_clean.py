"""Plant floaters into scenes and count which of them `--clean` finds, what else goes, and what held-out views lose.

    python -m benchmarks.check_clean [--level gentle|thorough] [--no-photos] [--as-is] [SCENE ...]

Each scene is a folder with `point_cloud.ply`, `cameras.json` and `images/`, or a file: with generated views, and nothing planted.
Default: the bundled scene, and fox and figure of `FLEXGS_SCENES`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.figures import SCENES_DIR
from benchmarks.harness import ROOT
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import SH_C0
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.quality.psnr import mse, psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.run.clean import cleaned
from flexgs_edge.run.few_poses import visible_depths
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import NO_PHOTOS, CompressOptions
from flexgs_edge.run.run import Run, open_run, planned
from flexgs_edge.scene.check import alive
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, Planes, SceneSource, SelectSource, read_all

KINDS = ("near cameras", "behind walls", "sky confetti", "needles")
EACH = 125
SEED = 1
TRIED = 16  # Of so many times as many candidates, those that views see least lie behind walls
Places = tuple[np.ndarray, np.ndarray]


class Planter:
    """Makes floaters where cameras look."""

    def __init__(self, source: SceneSource, cameras: Sequence[Camera], depths: Sequence[float]) -> None:
        self.rng, self.source, self.cameras, self.depths = np.random.default_rng(SEED), source, cameras, depths

    def places(self, count: int, nearest: float, farthest: float, bottom: float = 1.0) -> Places:
        """Positions ([3, n]) at shares of what the cameras usually have before them, and their distances to the camera."""
        found, far = np.empty((3, count)), np.empty(count)
        for i, number in enumerate(self.rng.integers(0, len(self.cameras), count)):
            camera = self.cameras[number]
            far[i] = self.depths[number] * np.exp(self.rng.uniform(np.log(nearest), np.log(farthest)))
            x, y = self.rng.uniform(0, camera.width), self.rng.uniform(0, bottom) * camera.height
            ray = np.array([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, 1.0])
            found[:, i] = camera.rotation.T @ (far[i] * ray - camera.translation)
        return found, far

    def planes(self, places: np.ndarray, scales: np.ndarray, opaque: float) -> Planes:
        """Gaussians of random colours and turns; logits up to `opaque`."""
        count = places.shape[1]
        made = {name: np.zeros((self.source.width(name), count), np.float32) for name in FIELD}
        made["means"][:] = places - self.source.origin[:, None]
        made["log_scales"][:] = np.log(scales)
        made["quats"][:] = self.rng.normal(size=(4, count))
        made["opacity_logits"][:] = self.rng.uniform(-2, opaque, count)
        made["sh_dc"][:] = (self.rng.uniform(0, 1, (3, count)) - 0.5) / SH_C0
        return made

    def blobs(self, found: Places, least: float, most: float, opaque: float = 3.0) -> Planes:
        """Gaussians as wide as shares of their distance."""
        places, far = found
        wide = far * self.rng.uniform(least, most, len(far))
        return self.planes(places, wide * self.rng.uniform(0.5, 1.5, (3, len(far))), opaque)

    def needles(self) -> Planes:
        """Long, thin Gaussians in the free space before the cameras."""
        places, far = self.places(EACH, 0.3, 0.9)
        thin = self.rng.uniform(0.0005, 0.003, (2, EACH))
        return self.planes(places, far * np.vstack([self.rng.uniform(0.05, 0.3, EACH), thin]), 3.0)


def joined(origin: np.ndarray, *parts: Planes) -> MemorySource:
    """One scene of several."""
    return MemorySource({name: np.concatenate([part[name] for part in parts], axis=1) for name in FIELD}, origin=origin)


def planted(run: Run[CompressOptions], renderer: Renderer) -> tuple[MemorySource, np.ndarray]:
    """The scene with floaters, and the kind of each row ([N] i8): a place in `KINDS`, -1 for its own rows."""
    source, cameras = run.source, run.seen.cameras
    own, planter = read_all(source, IN_MEMORY), Planter(source, cameras, visible_depths(renderer, source, cameras))
    near = planter.blobs(planter.places(EACH, 0.08, 0.35), 0.01, 0.06)
    hidden = planter.blobs(planter.places(TRIED * EACH, 1.15, 12.0), 0.005, 0.03, 4.0)
    both = joined(source.origin, own, hidden)
    statistics = Statistics.zeros(both.count)
    with renderer.load(both) as scene:
        for camera in cameras:
            renderer.add_statistics(scene, camera, statistics)
    renderer.release()
    least = np.argsort(statistics.weights[source.count :], kind="stable")[:EACH]
    walls = {name: values[:, least] for name, values in hidden.items()}
    confetti = planter.blobs(planter.places(EACH, 1.5, 5.0, bottom=0.4), 0.002, 0.01, 4.0)
    kinds = np.concatenate([np.full(source.count, -1), np.repeat(np.arange(len(KINDS)), EACH)])
    return joined(source.origin, own, near, walls, confetti, planter.needles()), kinds


def held_out(run: Run[CompressOptions], renderer: Renderer, source: SceneSource) -> float:
    """Mean PSNR of the held-out views against their photos, dB."""
    views = run.seen
    assert views.photos is not None
    with renderer.load(source) as scene:
        found = [
            psnr(mse(renderer.render(scene, views.cameras[i]), views.photos.load(i))) or 99.0 for i in views.held_out
        ]
    renderer.release()
    return float(np.mean(found))


def rows_gone(before: SceneSource, after: Run[CompressOptions]) -> np.ndarray:
    """[N] bool: the rows of `before` that a cleaning left out."""
    gone = np.ones(before.count, bool)
    kept = after.source
    assert isinstance(kept, SelectSource)
    gone[kept.rows] = False
    return gone


def measure(place: Path, level: str, photos: bool, plants: bool) -> None:
    """Print what a cleaning does to a scene, with floaters and as it is."""
    options = CompressOptions(clean=level, images=None if photos else NO_PHOTOS)
    run = planned(open_run(place, options))
    compared = planned(open_run(place, replace(options, images=None)))
    with open_renderer(run) as renderer:
        has_photos = compared.seen.photos is not None
        original = held_out(compared, renderer, run.source) if has_photos else 0.0
        if plants and place.is_dir():
            source, kinds = planted(run, renderer)
            clouded = held_out(compared, renderer, source) if has_photos else 0.0
            start = time.perf_counter()
            after = cleaned(run.of_source(source), renderer)
            seconds = time.perf_counter() - start
            gone = rows_gone(source, after)
            found = ", ".join(f"{name} {np.count_nonzero(gone[kinds == i])}" for i, name in enumerate(KINDS))
            share = np.count_nonzero(gone[kinds >= 0]) / np.count_nonzero(kinds >= 0)
            drawn = alive(source.read(slice(0, source.count), ["opacity_logits"])["opacity_logits"][0])
            others = np.count_nonzero(gone[(kinds < 0) & drawn])
            print(
                f"{place.name}, {level}, planted: {share:.1%} of {EACH} each go ({found}); others that are drawn {others} "
                f"({others / run.source.count:.3%}); {seconds:.0f} s",
                flush=True,
            )
            if has_photos:
                result = held_out(compared, renderer, after.source)
                words = (
                    f"{clouded:.3f} -> {result:.3f} dB, of the clean original {original:.3f} ({result - original:+.4f})"
                )
                print(f"  held-out PSNR {words}", flush=True)
            print(*(f"  {group}" for group in after.removed), sep="\n", flush=True)
        after = cleaned(run, renderer)
        lost = f", held-out PSNR {held_out(compared, renderer, after.source) - original:+.4f} dB" if has_photos else ""
        removed = run.source.count - after.source.count
        print(f"{place.name}, {level}, as it is: {removed} of {run.source.count} go{lost}", flush=True)
        print(*(f"  {group}" for group in after.removed), sep="\n", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--level", default="gentle", choices=("gentle", "thorough"))
    parser.add_argument("--no-photos", action="store_true")
    parser.add_argument("--as-is", action="store_true", help="plant nothing")
    parser.add_argument("scenes", nargs="*", type=Path)
    asked = parser.parse_args()
    for scene in asked.scenes or [ROOT / "samples" / "still_life", SCENES_DIR / "fox", SCENES_DIR / "figure"]:
        measure(scene, asked.level, not asked.no_photos, not asked.as_is)
