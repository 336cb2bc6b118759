"""Quantizing and dequantizing, ns by Gaussian.

python -m benchmarks.quantize [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

from collections import defaultdict

import numpy as np

from benchmarks.harness import SCENES, Bench, backend_of, check, parse
from flexgs_edge.codec.source import QuantizedSource
from flexgs_edge.prune import nonzero_sh
from flexgs_edge.quantize import quantize_scene
from flexgs_edge.render import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.ply import PlySource


def main() -> None:
    options = parse(__doc__, repeats=7)
    backend, budget = backend_of(options)
    bench = Bench(backend.name, options.repeats)
    source = PlySource(SCENES[options.scene] / "point_cloud.ply")
    has_sh = nonzero_sh(source)
    rows = np.flatnonzero(has_sh), np.flatnonzero(~has_sh)
    quantized = quantize_scene(source, *rows)
    note = f"{source.count} Gaussians of SH degree {source.sh_degree}, paper's bits"

    host = QuantizedSource(quantized)
    renderer = Renderer(backend, budget)
    with renderer.load_quantized(quantized) as scene:
        chunk = next(scene.chunks())
        ours = backend.read(chunk.means)[:, : chunk.count]
        check(np.array_equal(ours, host.read(slice(0, chunk.count), ["means"])["means"]), "dequantized positions")

    bench.time(
        "quantize", lambda: quantize_scene(source, *rows), "ns/Gaussian", source.count, f"{note}, read from the PLY"
    )
    bench.time(
        "dequantize, NumPy", lambda: host.read(slice(0, source.count), list(FIELD)), "ns/Gaussian", source.count, note
    )

    def load() -> None:
        """Loading decides where a scene lives when its chunks are first asked for."""
        with renderer.load_quantized(quantized) as scene:
            for _ in scene.chunks():
                pass

    seconds = []
    for _ in range(options.repeats + 1):
        backend.profile = defaultdict(float)
        load()
        seconds.append(backend.profile["dequantize"])
    backend.profile = None
    values = [s * 1e9 / source.count for s in seconds[1:]]
    bench.add("dequantize, kernel", values, "ns/Gaussian", f"{note}, first positions checked")
    check(min(values) > 0, "the kernel ran")
    bench.time("load a quantized scene", load, "ms", 1, note)


if __name__ == "__main__":
    main()
