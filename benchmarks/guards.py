"""Measures how a compressed scene looks away from the scored poses, with --views-margin off and on.

It reports fidelity at the training poses, and at the held-out views from other distances. It also reports the drop of the
held-out views (mean and worst), bytes and processor seconds.

python -m benchmarks.guards [--scene fox|sample] [--effort fast|balanced|max] [--only off|on]
    [--max-drop DB | --max-size BYTES] [--distil STEPS]
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, parse
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.generated import at_distance, between
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands.compress import compress
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.few_poses import visible_depths
from flexgs_edge.run.inputs import companions_of, load_scene, resolve_drawing
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import find_views
from flexgs_edge.scene.source import SceneSource

FACTORS = (0.25, 0.35, 0.5, 0.71, 1.0, 1.41, 2.0, 2.83, 4.0)


def fidelities(renderer: Renderer, original: SceneSource, coded: SceneSource, cameras: Sequence[Camera]) -> np.ndarray:
    """[n] f64, fidelity of each camera in dB."""
    with renderer.load(original) as scene:
        images = [renderer.render(scene, camera) for camera in cameras]
    with renderer.load(coded) as scene:
        found = [psnr(mse(renderer.render(scene, camera), image)) for camera, image in zip(cameras, images)]
    renderer.release()
    return np.array([200.0 if value is None else value for value in found])


def main() -> None:
    more = (
        ("--effort", {"default": "fast"}),
        ("--only", {"choices": ("off", "on")}),
        ("--max-drop", {"type": float, "default": 1.0}),
        ("--max-size", {"type": int, "metavar": "BYTES"}),
        ("--distil", {"type": int, "metavar": "STEPS"}),
    )
    options = parse(__doc__, repeats=1, scene="sample", more=more)
    backend, budget = backend_of(options)
    timer = Timer(backend.name, 1)
    path = SCENES[options.scene] / "point_cloud.ply"
    scene, companions = load_scene(path), companions_of(path)
    drawing = resolve_drawing(CompressOptions(), scene, companions)
    views = find_views(drawing, companions, scene.source)
    assert views is not None and drawing.near is not None and drawing.background is not None
    renderer = Renderer(backend, budget, drawing.near, drawing.background)
    train, held_out = views.of(views.train), views.of(views.held_out)
    depths = visible_depths(renderer, scene.source, held_out)
    sets = {"training poses": train}
    for factor in FACTORS:
        sets[f"held-out poses at {factor:g}x"] = [at_distance(c, d, factor) for c, d in zip(held_out, depths)]
    nearest = [min(train, key=lambda other: float(np.linalg.norm(other.center - c.center))) for c in held_out]
    sets["half way to the nearest pose"] = [between(c, other) for c, other in zip(held_out, nearest)]
    for margin in (False, True):
        if options.only == ("off" if margin else "on"):
            continue
        with tempfile.TemporaryDirectory() as name:
            place = Path(name) / "out.fgs"
            started = time.process_time()
            size = options.max_size
            target: dict[str, Any] = {"max_drop": options.max_drop} if size is None else {"max_size": size}
            chosen = CompressOptions(effort=options.effort, views_margin=margin, distil=options.distil, **target)
            result = compress(path, place, chosen)
            seconds = time.process_time() - started
            label = f"{options.scene}, {options.effort}, margin {'on' if margin else 'off'}"
            timer.add(f"{label}: bytes", [result.size], "B")
            timer.add(f"{label}: processor seconds", [seconds], "s")
            quality = result.quality
            assert quality is not None
            worst = quality.worst
            assert worst is not None
            mean, most = (quality.drop, worst.drop) if quality.drop is not None else (quality.modelled_drop, None)
            timer.add(f"{label}: mean drop", [mean], "dB")
            if most is not None:
                timer.add(f"{label}: worst view's drop", [most], "dB", f"allowed {1.5 * mean + 0.2:.3f}")
            coded = open_fgs(place)
            for kind, cameras in sets.items():
                found = fidelities(renderer, scene.source, coded, cameras)
                usual = mean_psnr(list(found))
                assert usual is not None
                timer.add(f"{label}: {kind}", [usual], "dB", f"worst {found.min():.2f}")


if __name__ == "__main__":
    main()
