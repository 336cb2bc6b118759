"""Times views by stage and by tile pair, scoring, steps of a descent, and the first image of a process.

python -m benchmarks.view [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse, read_sums, run_module
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.io.ply import PlySource
from flexgs_edge.methods.best.refit.descent import Descent
from flexgs_edge.methods.best.refit.finetune import FIELD_RATES, STRUCTURE, Schedule
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.run.few_poses import usual_depth
from flexgs_edge.scene.fields import FIELD

STAGES = {
    "projection": ("project",),
    "sort": ("sort_count_first", "sort_scatter_first", "sort_count", "sort_scatter", "exclusive_scan"),
    "tile lists": ("tile_room", "tile_count", "tile_scatter"),
    "blend": ("blend",),
}
"""Kernels of each stage of a view. The short scans of the tile lists count as sorting."""
VIEWS = 10


def tile_pairs(renderer: Renderer) -> int:
    """Number of tile pairs of the last view, which stands behind its tile counters."""
    buffers = renderer._buffers
    assert buffers is not None
    return int(renderer.backend.read(buffers.ends)[-1])


def bench_views(timer: Timer, renderer: Renderer, scene: DeviceScene, cameras: list[Camera]) -> None:
    """Time whole views, then their stages, with a wait after every kernel."""
    chosen = cameras[:: max(len(cameras) // VIEWS, 1)][:VIEWS]
    pairs = []
    for camera in chosen:
        renderer.render(scene, camera)
        pairs.append(tile_pairs(renderer))
    size = f"{chosen[0].width}x{chosen[0].height}"
    note = f"{len(chosen)} views {size}, {np.mean(pairs):.0f} pairs, kernels built before"

    def all_views() -> None:
        for camera in chosen:
            renderer.render(scene, camera)

    timer.time("view", all_views, "ms", len(chosen), note)
    backend, by_stage = renderer.backend, defaultdict(list)
    for _ in range(timer.repeats):
        backend.profile = defaultdict(float)
        all_views()
        for stage, kernels in STAGES.items():
            by_stage[stage].append(sum(backend.profile[kernel] for kernel in kernels) / len(chosen))
    backend.profile = None
    for stage, seconds in by_stage.items():
        timer.add(f"view: {stage}", [s * 1e3 for s in seconds], "ms", "a wait after each kernel")
        timer.add(f"view: {stage}, by pair", [s * 1e9 / (sum(pairs) / len(pairs)) for s in seconds], "ns/pair")


def bench_counting(
    timer: Timer, renderer: Renderer, scene: DeviceScene, cameras: list[Camera], golden: np.ndarray | None
) -> None:
    """Time counting hits and weights of every Gaussian over the training views."""
    train, _ = split_views(len(cameras))
    counted = []

    def count() -> None:
        statistics = Statistics.zeros(scene.count)
        for view in train:
            renderer.add_statistics(scene, cameras[view], statistics)
        counted.append(statistics.hits)

    timer.repeats = min(timer.repeats, 3)
    count()
    if golden is not None:
        check(abs(counted[0].sum() - golden.sum()) <= 1e-4 * golden.sum(), "hits over the training views")
    timer.time(
        "hit counting",
        count,
        "s",
        1,
        f"{len(train)} training views" + (", total checked" if golden is not None else ""),
    )
    bench_scores(timer, renderer, scene, [cameras[view] for view in train])


def bench_scores(timer: Timer, renderer: Renderer, scene: DeviceScene, cameras: list[Camera]) -> None:
    """Time hit counting and removal costs, relative to drawing. All three take turns view by view, under equal load."""
    statistics = Statistics.zeros(scene.count)
    ways: dict[str, Callable[[Camera], object]] = {
        "drawing": lambda camera: renderer.render(scene, camera),
        "hit counting": lambda camera: renderer.add_statistics(scene, camera, statistics),
        "removal costs": lambda camera: read_sums(renderer, renderer.removal_sums(scene, camera), 2, scene.count),
    }
    found = np.empty((len(ways), timer.repeats, len(cameras)))
    for repeat in range(timer.repeats):
        for place, camera in enumerate(cameras):
            for way, draw in enumerate(ways.values()):
                start = time.perf_counter()
                draw(camera)
                found[way, repeat, place] = time.perf_counter() - start
    totals = found.sum(axis=2)
    for way, name in enumerate(ways):
        if way:
            timer.add(f"{name} over drawing", (totals[way] / totals[0]).tolist(), "x", f"{len(cameras)} training views")


def bench_descent(timer: Timer, renderer: Renderer, source: PlySource, cameras: list[Camera]) -> None:
    """Time gradients of all values, and steps along them, relative to drawing the same views, in processor time."""
    chosen = cameras[:: max(len(cameras) // VIEWS, 1)][:VIEWS]
    planes = source.read(slice(0, source.count), list(FIELD))
    rates = {"means": Schedule.means_rate * usual_depth(renderer, source, chosen), **FIELD_RATES}
    with renderer.load(source) as scene:
        targets = [(0.9 * renderer.render_planes(scene, camera)).astype(np.float16) for camera in chosen]
        drawn = [
            _processor_ms(chosen, lambda k: renderer.render_planes(scene, chosen[k])) for _ in range(timer.repeats)
        ]
    degrees = np.full(source.count, source.sh_degree)
    with Descent(renderer, planes, degrees, source.origin, chosen[0], STRUCTURE) as descent:
        found: dict[str, list[float]] = {"gradients": [], "step": []}
        for _ in range(timer.repeats):
            found["gradients"].append(_processor_ms(chosen, lambda k: descent.differentiate(chosen[k], targets[k])))
            found["step"].append(_processor_ms(chosen, lambda k: descent.step(chosen[k], targets[k], rates)))
        check(all(np.isfinite(part).all() and part.any() for part in descent.gradients().values()), "gradients")
    note = f"{len(chosen)} views; processor time of all cores, the view included"
    for name, values in found.items():
        timer.add(f"descent: {name}", values, "ms", note)
    ratios = [a / b - 1 for a, b in zip(found["gradients"], drawn, strict=True)]
    timer.add("descent: backward over forward", ratios, "x", "gradients without their view, over the view")


def _processor_ms(chosen: list[Camera], run: Callable[[int], object]) -> float:
    """Processor time of one view in ms, after one that does not count."""
    run(0)
    start = time.process_time()
    for k in range(len(chosen)):
        run(k)
    return (time.process_time() - start) / len(chosen) * 1e3


def bench_first_image(timer: Timer, scene: str, device: str | None) -> None:
    """Time from the start of a process to its first image, without and with the compiler's cache."""
    arguments = ["--first-image", "--scene", scene, *(["--device", device] if device else [])]
    cold: list[float] = []
    warm: list[float] = []
    for _ in range(3):
        with tempfile.TemporaryDirectory() as cache:
            environment = {"POCL_CACHE_DIR": cache}
            for values in (cold, warm):
                start = time.perf_counter()
                run_module("view", *arguments, environment=environment)
                values.append(time.perf_counter() - start)
    timer.add("first image, cold", cold, "s", "new process, PoCL's kernel cache empty")
    timer.add("first image, warm", warm, "s", "new process, PoCL's kernel cache filled")


def main() -> None:
    options = parse(__doc__, repeats=7)
    folder = SCENES[options.scene]
    backend, budget = backend_of(options)
    cameras = read_cameras(folder / "cameras.json")
    renderer = Renderer(backend, budget)
    with renderer.load(PlySource(folder / "point_cloud.ply")) as scene:
        if options.first_image:
            check(bool(renderer.render(scene, cameras[0]).any()), "an empty image")
            return
        golden = _check_image(renderer, scene, cameras, options)
        timer = Timer(backend.name, options.repeats)
        bench_views(timer, renderer, scene, cameras)
        bench_counting(timer, renderer, scene, cameras, golden)
    bench_descent(timer, renderer, PlySource(folder / "point_cloud.ply"), cameras)
    renderer.release()
    if not backend.is_numpy and "POCL_CACHE_DIR" not in os.environ:
        bench_first_image(timer, options.scene, options.device)


def _check_image(
    renderer: Renderer, scene: DeviceScene, cameras: list[Camera], options: argparse.Namespace
) -> np.ndarray | None:
    """Compare with the golden image if there is one; returns the golden hits over the training views."""
    path = SCENES[options.scene] / "golden.npz"
    image = np.clip(renderer.render(scene, cameras[0]), 0, 1).astype(np.float64)
    check(np.isfinite(image).all() and image.any(), "an image of finite numbers")
    if not path.is_file():
        return None
    with np.load(path) as archive:
        error = np.mean((image - np.clip(archive["image_0"].astype(np.float64), 0, 1)) ** 2)
        check(error <= 1e-7, f"view 0 against its golden image: mean squared error {error:.3g}")
        return archive["hits_train"].astype(np.int64)


if __name__ == "__main__":
    main()
