"""Times one step of the paper's search: prune, quantize, dequantize, render the held-out views, compare.

python -m benchmarks.search [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

import time
from collections import defaultdict

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse
from flexgs_edge.goals.steps import Choice
from flexgs_edge.io.model_folder import find_companions
from flexgs_edge.methods.paper.method import Ranked, SceneEvaluator
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores
from flexgs_edge.packed.bitpack import PAPER
from flexgs_edge.packed.quantize import quantized_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.inputs import load_scene, resolve_drawing
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.view_set import find_views

CHOICE = Choice(400, 400)
"""Where the search begins: 40 % of the Gaussians pruned, a further 40 % without SH."""
PARTS = ("prune and quantize", "dequantize, render and compare")


def main() -> None:
    options = parse(__doc__, repeats=5)
    backend, budget = backend_of(options)
    timer = Timer(backend.name, options.repeats)
    path = SCENES[options.scene] / "point_cloud.ply"
    scene, companions = load_scene(path), find_companions(path)
    views = find_views(resolve_drawing(ViewOptions(), scene, companions), companions, scene.source)
    assert views is not None
    renderer = Renderer(backend, budget)
    judge = QualityEvaluator(renderer, scene.source, views, views.held_out)
    with renderer.load(scene.source) as original:
        judge.prepare(original)
    # The choice of Gaussians hardly changes the time of a step, so opacity times volume will do as a score.
    stored = scene.source.read(slice(0, scene.source.count), ["log_scales", "opacity_logits"])
    scores = stored["opacity_logits"][0] + 0.1 * stored["log_scales"].sum(axis=0)
    order = order_from_scores(scores.astype(np.float64))
    evaluator = SceneEvaluator(Ranked(scene.source, order, nonzero_sh(scene.source)), PAPER, None, judge, budget)
    measured = evaluator.measure(CHOICE)
    check(measured.fidelity is not None and 15 < measured.fidelity < 60, f"fidelity {measured.fidelity}")
    with evaluator.quantized(CHOICE) as quantized:
        bits = quantized_bytes(quantized.count, quantized.sh_count, quantized.sh_degree, PAPER)
        check(sum(array.nbytes for array in quantized.arrays.values()) == bits, "bytes as predicted")

    note = f"{len(views.held_out)} held-out views" + (" with photos" if views.photos else "") + ", kernels built before"
    timer.time("search step", lambda: evaluator.measure(CHOICE), "s", 1, note)
    parts: dict[str, list[float]] = defaultdict(list)
    for _ in range(options.repeats):
        marks = [time.perf_counter()]
        with evaluator.quantized(CHOICE) as quantized:
            marks.append(time.perf_counter())
            with renderer.load_quantized(quantized) as loaded:
                judge.compare(loaded)
                marks.append(time.perf_counter())
        for name, start, stop in zip(PARTS, marks, marks[1:]):
            parts[name].append(stop - start)
    for name, seconds in parts.items():
        timer.add(f"search step: {name}", seconds, "s")


if __name__ == "__main__":
    main()
