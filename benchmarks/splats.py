"""Times a view of a million random splats, which have no structure that would help.

python -m benchmarks.splats [--device SPEC] [--repeats N]

The picture has 1280x720 pixels. Splats have standard deviations of 2 pixels and mean opacities of 0.3; they are uniform over
the picture and over depths of 1 to 10.
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from benchmarks.harness import Timer, backend_of, check, parse
from benchmarks.view import STAGES
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import MemorySource

COUNT, WIDTH, HEIGHT, FOCAL = 1_000_000, 1280, 720, 1000.0
SIGMA, OPACITY, SEED = 2.0, 0.3, 0


def random_splats(count: int = COUNT) -> MemorySource:
    """The scene, made for a camera at the origin that looks along z."""
    rng = np.random.default_rng(SEED)
    depth = rng.uniform(1, 10, count)
    x = rng.uniform(-WIDTH / 2, WIDTH / 2, count) * depth / FOCAL
    y = rng.uniform(-HEIGHT / 2, HEIGHT / 2, count) * depth / FOCAL
    opacity = np.clip(rng.beta(1.5, 1.5 * (1 - OPACITY) / OPACITY, count), 0.01, 0.99)
    planes = {
        "means": np.stack([x, y, depth]),
        "log_scales": np.log(SIGMA * depth / FOCAL) + np.zeros((3, 1)),
        "quats": rng.normal(size=(4, count)),
        "opacity_logits": np.log(opacity / (1 - opacity))[None],
        "sh_dc": rng.normal(0, 0.5, (3, count)),
        "sh_rest": np.zeros((0, count)),
    }
    return MemorySource({name: plane.astype(np.float32) for name, plane in planes.items()})


def main() -> None:
    options = parse(__doc__, repeats=7)
    backend, budget = backend_of(options)
    cx, cy = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    camera = Camera("random", WIDTH, HEIGHT, np.eye(3), np.zeros(3), FOCAL, FOCAL, cx, cy)
    renderer = Renderer(backend, budget)
    timer = Timer(backend.name, options.repeats)
    with renderer.load(random_splats()) as scene:
        image = renderer.render(scene, camera)
        check(bool(np.isfinite(image).all()), "an image of finite numbers")
        # Some 100 splats lie over every pixel, so they hide the background, and colours average to about 0.5.
        check(bool(abs(image.mean() - 0.5) < 0.05 and image.std() < 0.25), "an even picture")
        check(np.array_equal(image, renderer.render(scene, camera)), "the same picture again")
        note = f"{COUNT} splats, {WIDTH}x{HEIGHT}, kernels built before"
        timer.time("random splats: view", lambda: renderer.render(scene, camera), "ms", 1, note)
        backend.profile = defaultdict(float)
        renderer.render(scene, camera)
        for stage, kernels in STAGES.items():
            seconds = sum(backend.profile[kernel] for kernel in kernels)
            timer.add(f"random splats: {stage}", [seconds * 1e3], "ms", "a wait after each kernel")
    renderer.release()


if __name__ == "__main__":
    main()
