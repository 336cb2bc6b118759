"""Bits that the coder of container version 2 takes for each channel, beside the order-0 entropy of the same integers.

Without --file it codes the base payload: every Gaussian of the scene, with geometry, opacity and refitted constant colour
on grids, and exact SH above degree 0. The loss against the held-out photos is measured on decoded values.

python -m benchmarks.coder [--scene fox|sample] [--device SPEC] [--file FILE.fgs] [--steps POSITION SCALE ROTATION OPACITY DC]
"""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path

import numpy as np

from benchmarks.harness import SCENES, Timer, check
from flexgs_edge.codec.v2.container import channel_bytes, write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import recolour, to_grid
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.choose_steps import CHROMA
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.progress import Progress
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.inputs import companions_of, load_scene, resolve_drawing
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.view_set import find_views
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original, References

STEPS = (0.002, 0.2, 0.04, 0.3, 0.06)
"""Step sizes of position, scale, rotation, opacity and constant colour, in fox's units."""
MOST_BITS, MOST_DROP = 62.0, 0.15
"""Most bits a Gaussian and most dB of loss for the base payload of fox."""
ROUNDS, SUBSETS = 2, 3
"""Rounds of the refit, and steps of a round."""


def entropy_bits(planes: np.ndarray) -> float:
    """Sum of the order-0 entropies of the planes ([m, n] integers), in bits."""
    total = 0.0
    for plane in planes:
        counts = np.unique(plane, return_counts=True)[1]
        total -= float((counts * np.log2(counts / max(plane.size, 1))).sum())
    return total


def channels(grid: GridScene) -> dict[str, np.ndarray]:
    """[m, n] integers of every channel, by the first word of its name in `channel_bytes`."""
    named = {
        "position": grid.position,
        "scale": grid.scale,
        "rotation": grid.rotation,
        "opacity": grid.opacity[None],
        "dc": grid.dc,
    }
    if grid.sh_degree:
        named["sh degree"] = grid.sh_degrees[None]
    return named | {f"sh {degree}": band for degree, band in enumerate(grid.sh, start=1)}


def report(timer: Timer, path: Path, what: str) -> float:
    """Report one result for each channel; returns the bits a Gaussian of the whole file."""
    source = GridSource(path)
    grid, coded = source.grid(), channel_bytes(path)
    coded["position"] += coded.pop("repeats")
    rest = dict(coded)
    for name, planes in channels(grid).items():
        parts = [part for part in rest if part == name or (part.startswith(f"{name} ") and part != "sh degree")]
        bits = 8 * sum(rest.pop(part) for part in parts) / grid.count
        bound = entropy_bits(planes) / grid.count
        timer.add(f"{what}: {name}", [bits], "bits/Gaussian", f"order-0 entropy of {len(planes)} planes: {bound:.4g}")
    other = 8 * sum(rest.values()) / grid.count
    timer.add(f"{what}: tables, lanes and header", [other], "bits/Gaussian")
    whole = 8 * path.stat().st_size / grid.count
    check(abs(8 * sum(coded.values()) / grid.count - whole) < 1e-6, "channels add up to the file")
    timer.add(f"{what}: whole file", [whole], "bits/Gaussian", f"{grid.count} Gaussians, {path.stat().st_size} bytes")
    return whole


def base_payload(scene_path: Path, output: Path, steps: StepSizes, device: str | None, progress: Progress) -> Quality:
    """Write the base of every Gaussian of a scene, and measure it with the scene's own SH."""
    scene, companions = load_scene(scene_path), companions_of(scene_path)
    views = find_views(resolve_drawing(ViewOptions(), scene, companions), companions, scene.source)
    assert views is not None
    budget = MemoryBudget.from_limit(None)
    backend = open_backend(device, budget)
    source, cameras = scene.source, views.of(views.train)
    renderer = Renderer(backend, budget, near=DEFAULT_NEAR)
    judge = QualityEvaluator(renderer, source, views, views.held_out)
    try:
        with renderer.load(source) as original:
            judge.prepare(original, progress)
            targets = References.of(renderer, original, cameras, progress=progress)
        planes = source.read(slice(0, source.count), list(FIELD))
        grid, order = to_grid(planes, np.zeros(source.count, np.uint8), steps, source.origin)
        exact = {"sh_rest": np.ascontiguousarray(planes["sh_rest"][:, order])}
        # The refit starts from the original colours, with geometry from the grid.
        start = {**from_grid(grid), **exact, "sh_dc": np.ascontiguousarray(planes["sh_dc"][:, order])}
        degrees = np.full(source.count, source.sh_degree, np.uint8)
        with targets:
            refitted = refit_colours(
                start,
                degrees,
                Original(renderer, source.origin, cameras, targets, (), progress),
                ROUNDS,
                False,
                SUBSETS,
            )
        write_grid(output, recolour(grid, refitted["sh_dc"], exact["sh_rest"]), {}, force=True)
        decoded = GridSource(output)
        values = {**decoded.read(slice(0, decoded.count), list(FIELD)), **exact}
        with renderer.load(MemorySource(values, source.sh_degree, decoded.origin)) as compressed:
            return judge.compare(compressed, progress=progress)
    finally:
        judge.close()
        renderer.release()
        backend.close()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default="fox", help="default: %(default)s")
    parser.add_argument("--device", help="as for flexgs-edge; default: the device that it would take")
    parser.add_argument("--file", type=Path, help="a .fgs of version 2 instead")
    parser.add_argument("--steps", type=float, nargs=5, default=STEPS, help="default: %(default)s")
    options = parser.parse_args()
    timer = Timer("NumPy", 1)
    if options.file is not None:
        report(timer, options.file, options.file.name)
        return
    kinds = ("position", "scale", "rotation", "opacity", "dc")
    steps = StepSizes(**dict(zip(kinds, options.steps, strict=True)), sh=(), chroma=CHROMA)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "base.fgs"
        quality = base_payload(SCENES[options.scene] / "point_cloud.ply", path, steps, options.device, Progress())
        whole = report(timer, path, "base")
    assert quality.drop is not None and quality.fidelity is not None
    note = f"SH exact, constant refitted, held-out photos; steps {', '.join(f'{step:g}' for step in options.steps)}"
    timer.add("base: drop", [quality.drop], "dB", note)
    timer.add("base: fidelity", [quality.fidelity], "dB", note)
    if options.scene == "fox" and tuple(options.steps) == STEPS:
        check(whole <= MOST_BITS and quality.drop <= MOST_DROP, f"at most {MOST_BITS} bits at {MOST_DROP} dB")


if __name__ == "__main__":
    main()
