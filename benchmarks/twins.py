"""Times a view drawn by the NumPy twins, as with `--device numpy`.

python -m benchmarks.twins [--scene fox|sample] [--repeats N]
"""

from __future__ import annotations

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.io.ply import PlySource
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer


def main() -> None:
    options = parse(__doc__, repeats=3, scene="sample")
    folder = SCENES[options.scene]
    source, camera = PlySource(folder / "point_cloud.ply"), read_cameras(folder / "cameras.json")[3]
    backend, budget = backend_of(options)
    kernels = Renderer(backend, budget)
    with kernels.load(source) as scene:
        expected = kernels.render(scene, camera)
    kernels.release()
    budget = MemoryBudget.from_limit(None)
    twins = Renderer(open_backend("numpy", budget), budget)
    with twins.load(source) as scene:
        check(np.array_equal(twins.render(scene, camera), expected), "the kernels' bits")
        timer = Timer("numpy", options.repeats)
        note = f"{camera.width}x{camera.height}, {source.count} Gaussians, same bits as {backend.name}"
        timer.time("view on the twins", lambda: twins.render(scene, camera), "s", 1, note)
    twins.release()


if __name__ == "__main__":
    main()
