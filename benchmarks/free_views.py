"""Judges made scenes of several things, compressed alone, from free views near each of their parts.

    python -m benchmarks.free_views --effort fast --views 12 lamps street

The program sees no cameras. A part fails where its views have less than 30 dB of fidelity over what the original covers, though
the whole keeps the promise; a warning about places that no view shows is printed with it.
"""

from __future__ import annotations

import argparse
import math
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.camera_files import inria_json
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.constants import SH_C0
from flexgs_edge.io.ply import write_ply
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.scene.source import MemorySource, Planes

LEAST = 30.0
"""Least fidelity of a part, dB."""
DISTANCES = (2.5, 4.0)
"""Distances of free views from the centre of a part, in its radii. Views of what surrounds them stand near its centre."""
SIZE, FOCAL = 160, 180.0


@dataclass(frozen=True)
class Part:
    """Gaussians on a sphere, and where views of them stand.

    `inside`: views look out from near the centre. `towards`: views lie within 60 degrees of this direction. Default: all around.
    """

    centre: tuple[float, float, float]
    radius: float
    count: int = 400
    colour: float = 0.6
    opacity: float = 3.0
    squeezed: tuple[float, float, float] = (1.0, 1.0, 1.0)
    inside: bool = False
    towards: tuple[float, float, float] | None = None

    def planes(self, seed: int) -> Planes:
        """Splats as wide as their distances, in colours of a smooth pattern."""
        rng, on = np.random.default_rng(seed), fibonacci(self.count).T
        shape = np.array(self.squeezed)[:, None]
        wave = np.sin(on * rng.uniform(3, 9, (3, 1)) + rng.uniform(0, 6, (3, 1)))
        colours = np.clip(self.colour * (1 + 0.4 * wave) + 0.03 * rng.normal(size=on.shape), 0.0, 1.0)
        size = 2.2 * self.radius / math.sqrt(self.count) * math.sqrt(float(np.sort(shape[:, 0])[1:].prod()))
        quats = rng.normal(size=(4, self.count))
        planes = {
            "means": np.array(self.centre)[:, None] + self.radius * shape * on,
            "log_scales": math.log(size) + rng.normal(0, 0.2, on.shape),
            "quats": quats / np.linalg.norm(quats, axis=0),
            "opacity_logits": self.opacity + rng.normal(0, 0.5, (1, self.count)),
            "sh_dc": (colours - 0.5) / SH_C0,
        }
        return {name: values.astype(np.float32) for name, values in planes.items()}

    def cameras(self, count: int) -> list[Camera]:
        """Free views of the part."""
        directions = fibonacci(count if self.towards is None else 4 * count)
        if self.towards is not None:
            towards = np.array(self.towards) / np.linalg.norm(self.towards)
            directions = directions[directions @ towards > 0.5]
        found = []
        for number, direction in enumerate(directions):
            far = 0.2 if self.inside else DISTANCES[number % len(DISTANCES)]
            eye = np.array(self.centre) + far * self.radius * direction
            found.append(_looking(f"v{number:03}", eye, direction if self.inside else -direction))
        return found


def _looking(name: str, eye: np.ndarray, forward: np.ndarray) -> Camera:
    side = np.cross(forward, (0.0, 0.0, 1.0) if abs(forward[1]) > 0.9 else (0.0, 1.0, 0.0))
    side /= np.linalg.norm(side)
    rotation = np.stack([side, np.cross(forward, side), forward])
    middle = (SIZE - 1) / 2
    return Camera(name, SIZE, SIZE, rotation, -rotation @ eye, FOCAL, FOCAL, middle, middle)


def _row(count: int, apart: float, radius: float, **words: float) -> list[Part]:
    return [Part((apart * k, 0.0, 0.0), radius, **words) for k in range(count)]  # type: ignore[arg-type]


def _ring(count: int, wide: float, radius: float) -> list[Part]:
    angles = [2 * math.pi * k / count for k in range(count)]
    return [Part((wide * math.cos(a), 0.0, wide * math.sin(a)), radius) for a in angles]


FLOOR = Part((0.0, 1.0, 0.0), 20.0, 3000, squeezed=(1.0, 0.01, 1.0), towards=(0.0, -1.0, 0.0))
SCENES: dict[str, Callable[[], list[Part]]] = {
    "lamps": lambda: _row(8, 6.0, 0.3),
    "far lamp": lambda: [Part((0, 0, 0), 2.0, 5000), Part((60.0, 0, 0), 0.3, 200)],
    "street": lambda: [
        FLOOR, *(Part((3.0 * k - 9, 0.5, side), 0.5, 300) for k in range(6) for side in (-2.0, 2.0)),
    ],
    "rooms": lambda: [
        part for x in (-6.0, 6.0) for z in (-6.0, 6.0)
        for part in (Part((x, 0, z), 4.0, 1500, inside=True), Part((x, 1.0, z), 0.4, 300))
    ],
    "inside out": lambda: [Part((0, 0, 0), 5.0, 3000, inside=True), Part((0, 0, 1.0), 0.3)],
    "hidden": lambda: [
        Part((0, 0, 0), 0.3), *(Part((0, 0, z), 2.0, 2000, squeezed=(1, 1, 0.05)) for z in (-1.5, 1.5)),
    ],
    "dark on dark": lambda: [Part((0, 0, 0), 1.0, 2000, 0.02), Part((4.0, 0, 0), 0.5, 500, 0.04)],
    "dark beside bright": lambda: [Part((0, 0, 0), 1.0, 2000, 0.9), Part((4.0, 0, 0), 0.5, 500, 0.04)],
    "sky": lambda: [Part((0, 0, 0), 50.0, 3000, inside=True), Part((0, 0, 0), 0.25, 2000)],
    "tiny": lambda: [Part((0, 0, 0), 2.0, 3000), Part((3.0, 0, 0), 0.02, 300)],
    "beside a giant": lambda: [Part((0, 0, 0), 10.0, 4000), Part((10.3, 0, 0), 0.1, 300, towards=(1.0, 0, 0))],
    "tower": lambda: [Part((0, -3.0 * k, 0), 0.6) for k in range(8)],
    "picture on a wall": lambda: [
        Part((0, 0, 0), 5.0, 3000, squeezed=(1, 1, 0.01), towards=(0, 0, -1)),
        Part((2.0, 1.0, -0.1), 0.2, 400, 0.3, squeezed=(1, 1, 0.1), towards=(0, 0, -1)),
    ],
    "faint": lambda: [Part((0, 0, 0), 1.0, 2000), Part((5.0, 0, 0), 1.0, 1000, 0.5, -2.0)],
    "under glass": lambda: [Part((0, 0, 0), 1.0, 1500, 0.8, -3.0), Part((0, 0, 0), 0.3, 400, 0.3)],
    "lattice": lambda: [Part((3.0 * x, 3.0 * y, 3.0 * z), 0.4, 150) for x in range(3) for y in range(3) for z in range(3)],
    "ring": lambda: _ring(12, 8.0, 0.4),
    "joined rooms": lambda: [
        *(Part((x, 0, 0), 2.0, 8000, inside=True) for x in (-1.95, 1.95)), Part((2.0, 1.75, 0), 0.3, 250),
    ],
    "joined balls": lambda: [Part((1.9 * k, 0, 0), 1.0, 2000, inside=True) for k in range(5)],
    "shell": lambda: [Part((0, 0, 0), 3.0, 40_000, inside=True)],
}  # fmt: skip


def judged(name: str, effort: str, views: int) -> str:
    """A line of a table about a scene: what it takes, its promise, the worst parts, and warnings."""
    parts = SCENES[name]()
    made = [part.planes(seed) for seed, part in enumerate(parts)]
    planes = {field: np.concatenate([each[field] for each in made], axis=1) for field in made[0]}
    with tempfile.TemporaryDirectory() as folder:
        scene, coded, cameras = (Path(folder) / name for name in ("scene.ply", "scene.fgs", "free.json"))
        write_ply(scene, MemorySource(planes, 0))
        started = time.process_time()
        result = compress(scene, coded, CompressOptions(effort=effort))
        seconds = time.process_time() - started
        found = []
        for number, part in enumerate(parts):
            cameras.write_text(inria_json(part.cameras(views)))
            quality = evaluate(coded, scene, cameras=str(cameras), images="none", holdout=0).quality
            fidelity = quality.covered_fidelity
            found.append((200.0 if fidelity is None else fidelity, number))
    low = [f"part {number} {fidelity:.1f}" for fidelity, number in sorted(found) if fidelity < LEAST]
    told = "; ".join(warning for warning in result.warnings if "view" in warning)
    count = planes["means"].shape[1]
    words = f"{count} -> {result.count}", f"least {min(found)[0]:.1f} dB", ", ".join(low) or "all hold", told or "-"
    return " | ".join((name, effort, *words, f"{seconds:.0f} s"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help=f"of {', '.join(SCENES)}; default: all")
    parser.add_argument("--effort", choices=("fast", "balanced"), default="fast")
    parser.add_argument("--views", type=int, default=100, help="free views of each part")
    options = parser.parse_args()
    for name in options.scenes or SCENES:
        print(judged(name, options.effort, options.views), flush=True)


if __name__ == "__main__":
    main()
