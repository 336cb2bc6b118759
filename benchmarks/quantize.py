"""Times quantizing and dequantizing, in ns a Gaussian.

python -m benchmarks.quantize [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

import time
from collections import defaultdict

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse
from flexgs_edge.io.ply import PlySource
from flexgs_edge.methods.paper.prune import nonzero_sh
from flexgs_edge.packed.quantize import QuantizedScene, dequantize, quantize_scene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource

LARGE = 1_000_000
"""Gaussians for the comparison with the loop over groups."""


def quantize_in_a_loop(scene: QuantizedScene, source: MemorySource) -> dict[str, np.ndarray]:
    """The baseline, by channels and groups, without packing codes. Returns decoded values, [c, n] f32 by field."""
    decoded = {}
    planes = source.read(slice(0, source.count), list(FIELD))
    for name, array in scene.arrays.items():
        values, most = planes[name][:, : array.count], 2**array.bits - 1
        codes, out = np.empty(values.shape, np.uint16), np.empty_like(values)
        for channel, row in enumerate(values):
            for group in range(array.groups):
                part = slice(group * array.count // array.groups, (group + 1) * array.count // array.groups)
                low, high = row[part].min(), row[part].max()
                step = (high - low) / np.float32(most)
                ranks = np.rint((row[part] - low) / (step if step > 0 else np.float32(1)))
                codes[channel, part] = np.clip(ranks, 0, most)
                out[channel, part] = low + codes[channel, part] * step
        decoded[name] = out
    return decoded


def dequantized(quantized: QuantizedScene) -> MemorySource:
    """The values of a quantized scene; rows without SH have zeros."""
    arrays = {name: dequantize(array, slice(None)) for name, array in quantized.arrays.items()}
    if quantized.contraction is not None:
        arrays["means"] = quantized.contraction.expand(arrays["means"])
    arrays["sh_rest"] = np.pad(arrays["sh_rest"], ((0, 0), (0, quantized.count - arrays["sh_rest"].shape[1])))
    return MemorySource(arrays, quantized.sh_degree, quantized.origin, sh_count=quantized.sh_count)


def bench_against_loop(timer: Timer, source: PlySource) -> None:
    """Time both ways, there and back, in turn."""
    planes = source.read(slice(0, source.count), list(FIELD))
    copies = -(-LARGE // source.count)
    large = MemorySource({k: np.ascontiguousarray(np.tile(v, copies)[:, :LARGE]) for k, v in planes.items()})
    rows = np.arange(LARGE), np.zeros(0, np.int64)
    loop, ours, ratios = [], [], []
    for _ in range(timer.repeats):
        start = time.perf_counter()
        quantized = quantize_scene(large, *rows)
        back = dequantized(quantized).read(slice(0, LARGE), list(FIELD))
        middle = time.perf_counter()
        baseline = quantize_in_a_loop(quantized, large)
        loop.append((time.perf_counter() - middle) * 1e3)
        ours.append((middle - start) * 1e3)
        ratios.append(loop[-1] / ours[-1])
        for name, values in baseline.items():
            if name == "quats":
                continue  # quaternions are normalized before they are quantized
            most = (quantized.arrays[name].step.max(axis=1) * 1.01)[:, None]
            check(bool((np.abs(values - back[name]) <= most).all()), f"{name} of the loop")
    note = (
        f"{LARGE} Gaussians of SH degree {source.sh_degree} in memory, there and back; the loop's values within a step"
    )
    timer.add("quantize and dequantize, NumPy", ours, "ms", note)
    timer.add("quantize and dequantize, a loop over groups", loop, "ms", note)
    timer.add("a loop over groups, of ours", ratios, "times", note)


def main() -> None:
    options = parse(__doc__, repeats=7)
    backend, budget = backend_of(options)
    timer = Timer(backend.name, options.repeats)
    source = PlySource(SCENES[options.scene] / "point_cloud.ply")
    has_sh = nonzero_sh(source)
    rows = np.flatnonzero(has_sh), np.flatnonzero(~has_sh)
    quantized = quantize_scene(source, *rows)
    note = f"{source.count} Gaussians of SH degree {source.sh_degree}, paper's bits"

    renderer = Renderer(backend, budget)
    with renderer.load_quantized(quantized) as scene:
        chunk = next(scene.chunks())
        ours = backend.read(chunk.means)[:, : chunk.count]
        check(
            np.array_equal(ours, dequantized(quantized).read(slice(0, chunk.count), ["means"])["means"]),
            "dequantized positions",
        )

    timer.time(
        "quantize", lambda: quantize_scene(source, *rows), "ns/Gaussian", source.count, f"{note}, read from the PLY"
    )
    timer.time("dequantize, NumPy", lambda: dequantized(quantized), "ns/Gaussian", source.count, note)

    def load() -> None:
        """Load the scene and ask for its chunks: only then is it decided where it lives."""
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
    timer.add("dequantize, kernel", values, "ns/Gaussian", f"{note}, first positions checked")
    check(min(values) > 0, "the kernel ran")
    timer.time("load a quantized scene", load, "ms", 1, note)
    timer.repeats = min(timer.repeats, 3)
    bench_against_loop(timer, source)


if __name__ == "__main__":
    main()
