"""Compares the blend with the machine's peak: the same arithmetic alone, on data in the nearest cache.

python -m benchmarks.peak [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

import os
import time
from collections import defaultdict
from pathlib import Path

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.constants import TILE
from flexgs_edge.io.ply import PlySource
from flexgs_edge.kernels.cl_sources import load_source
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics

SPLATS, BLOCKS, ROUNDS, ITEMS = 8, 8, 100_000, 16
"""Eight blocks that do not wait for each other; fewer leave parts of a core idle. They run for a twentieth of a second, because
short runs would measure how long cores take to wake."""
VIEWS = 10

ARITHMETIC = f"""
__kernel void peak(const uint rounds, __global const float *records, __global float *out) {{
  FW red[{BLOCKS}], green[{BLOCKS}], blue[{BLOCKS}], trans[{BLOCKS}], xs[{BLOCKS}];
  const FW y = TO_F(LANE_INDEX >> 2);
  for (int k = 0; k < {BLOCKS}; ++k) {{
    red[k] = green[k] = blue[k] = (FW)0.0f;
    trans[k] = (FW)1.0f;
    xs[k] = TO_F((LANE_INDEX & 3) + 4 * k);
  }}
  for (uint n = 0; n < rounds; ++n) {{
    __global const float *r = records + (n & {SPLATS - 1}) * 16;
    const FW mx = (FW)r[0], my = (FW)r[1], ca = (FW)r[2], cb = (FW)r[3], cc = (FW)r[4], level = (FW)r[5];
    const FW cr = (FW)r[6], cg = (FW)r[7], cbl = (FW)r[8];
#pragma unroll
    for (int k = 0; k < {BLOCKS}; ++k) {{
      FW dx = xs[k] - mx, dy = y - my;
      FW alpha, weight;
      const FW exponent = splat_exponent(dx, dy, ca, cb, cc, level, highest_exponent(level));
      blend_over(exponent, cr, cg, cbl, red + k, green + k, blue + k, trans + k, &alpha, &weight);
    }}
  }}
  FW all = (FW)0.0f;
  for (int k = 0; k < {BLOCKS}; ++k) all += red[k] + green[k] + blue[k] + trans[k];
  STOREF(all, out, get_global_id(0) * W);
}}
"""
"""The blend's step with all lanes of its vectors in use. Splats, pixels and colours never leave the nearest cache."""


def bench_peak(timer: Timer, backend: OpenCLBackend) -> float:
    """Measure the lanes a second of the arithmetic alone, on all cores."""
    session, width = backend, backend.width
    source = load_source("dequantize.cl") + ARITHMETIC  # the file brings constants and helpers
    kernel = session.kernel(source, "peak", (f"-DW={width}",), "ubb")
    records = np.zeros((SPLATS, 16), np.float32)
    records[:, 0], records[:, 1] = np.arange(SPLATS) * 2, 1.5
    records[:, 2] = records[:, 4] = 0.01
    records[:, 5], records[:, 6:9] = -6.0, 0.5
    held, out = backend.array(records.shape, np.float32), backend.array((ITEMS * width,), np.float32)
    backend.write(held, records)

    def run() -> None:
        session.enqueue("peak", kernel, (ITEMS,), (1,), (ROUNDS, held, out))
        session.close()

    run()
    sums = backend.read(out)
    check(bool(np.isfinite(sums).all() and (sums > 0).all()), "sums of light of the arithmetic alone")
    lanes = ITEMS * ROUNDS * BLOCKS * width
    seconds = []
    for _ in range(timer.repeats):
        start = time.perf_counter()
        run()
        seconds.append(time.perf_counter() - start)
    timer.add("arithmetic alone", [lanes / s / 1e9 for s in seconds], "G lanes/s", f"W = {width}, all cores")
    held.release()
    out.release()
    return lanes / min(seconds)


def bench_share(timer: Timer, backend: OpenCLBackend, renderer: Renderer, folder: Path, peak: float) -> None:
    """Measure the blend of real views, as a share of the peak."""
    cameras = read_cameras(folder / "cameras.json")
    cameras = cameras[:: max(len(cameras) // VIEWS, 1)][:VIEWS]
    with renderer.load(PlySource(folder / "point_cloud.ply")) as scene:
        statistics = Statistics.zeros(scene.count)
        pairs = blended = 0
        for camera in cameras:
            renderer.add_statistics(scene, camera, statistics)
            buffers = renderer._buffers
            assert buffers is not None
            count = int(backend.read(buffers.ends)[-1])
            masks = backend.read(buffers.pairs)[:count, 1].astype(np.uint16)
            pairs += count
            blended += int(np.unpackbits(masks.view(np.uint8)).sum()) * 16
        hits = int(statistics.hits.sum())
        seconds = []
        for _ in range(timer.repeats):
            backend.profile = defaultdict(float)
            for camera in cameras:
                renderer.render(scene, camera)
            seconds.append(backend.profile["blend"])
        backend.profile = None
    cores = len(os.sched_getaffinity(0))
    listed = pairs * TILE * TILE
    each = [s * 1e9 * cores / listed for s in seconds]
    timer.add("blend, by listed tile pixel and core", each, "ns", f"{len(cameras)} views, {cores} cores")
    timer.add("lanes of listed blocks, of listed tile pixels", [blended / listed], "share")
    timer.add("useful lanes (blended pixels), of lanes of listed blocks", [hits / blended], "share")
    timer.add("blend: useful lanes, of the arithmetic alone", [hits / s / peak for s in seconds], "share")


def main() -> None:
    options = parse(__doc__, repeats=7)
    backend, budget = backend_of(options)
    check(isinstance(backend, OpenCLBackend), "an OpenCL device")
    assert isinstance(backend, OpenCLBackend)
    timer = Timer(backend.name, options.repeats)
    peak = bench_peak(timer, backend)
    renderer = Renderer(backend, budget)
    bench_share(timer, backend, renderer, SCENES[options.scene], peak)
    renderer.release()


if __name__ == "__main__":
    main()
