"""Times the coder of container version 2: a scene to its grid, to a file, and back to a PLY, in M Gaussians a second.

python -m benchmarks.codec [--scene fox|sample] [--rows N] [--repeats N] [--device SPEC]

Rows are copies of the scene's larger Gaussians with a little noise, side by side. Half of them have SH, as after a search.
`--rows 0` takes these Gaussians once. Everything is NumPy except results "on the device" and "file to PLY". The rate of
the last one leaves out opening the device and building its kernels.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.harness import SCENES, Timer, backend_of, check, parse
from flexgs_edge.codec.open_fgs import verify
from flexgs_edge.codec.v2.container import channel_bytes, coded_size, write_grid
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.grid.grid_scene import from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import PlySource
from flexgs_edge.methods.best.grid_coder import bit_model
from flexgs_edge.scene.fields import FIELD

KEPT = 0.47
"""Share of the scene's rows to take: the largest and most opaque ones."""
DEGREES = (0.5, 0.65, 0.8)
"""Rows get SH of degree 1, 2 and 3 from these ranks on, by the size of their SH."""


def some_rows(path: Path, count: int, steps: StepSizes) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Planes of `count` rows (0: the taken rows once), and their SH degrees."""
    source = PlySource(path)
    planes = source.read(slice(0, source.count), list(FIELD))
    size = planes["log_scales"].sum(axis=0) + planes["opacity_logits"][0]
    kept = np.sort(np.argsort(-size, kind="stable")[: int(KEPT * source.count)])
    away = np.abs(planes["means"] - np.median(planes["means"], axis=1, keepdims=True)).max(axis=0)
    kept = kept[away[kept] < np.quantile(away, 0.98)]
    planes = {name: plane[:, kept] for name, plane in planes.items()}
    rank = np.abs(planes["sh_rest"]).sum(axis=0).argsort().argsort() / len(kept)
    degrees = np.searchsorted(DEGREES, rank, side="right").astype(np.uint8)
    if not count:
        return planes, degrees
    rng = np.random.default_rng(0)
    copies = -(-count // len(kept))
    width = np.ptp(planes["means"], axis=1)[:, None]
    noise = {"means": 4 * steps.position, "sh_dc": 0.02, "sh_rest": 0.02, "log_scales": 0.02}
    parts: dict[str, list[np.ndarray]] = {name: [] for name in planes}
    for i in range(copies):
        for name, plane in planes.items():
            part = plane + rng.normal(0, noise.get(name, 0.01), plane.shape).astype(np.float32)
            if name == "means":
                part += np.array([i % 4, i // 4 % 4, i // 16], np.float32)[:, None] * width
            parts[name].append(part.astype(np.float32))
    tiled = {name: np.ascontiguousarray(np.concatenate(part, axis=1)[:, :count]) for name, part in parts.items()}
    return tiled, np.tile(degrees, copies)[:count]


def main() -> None:
    options = parse(
        __doc__, repeats=3, more=[("--rows", {"type": int, "default": 1_000_000, "help": "default: %(default)s"})]
    )
    backend, _ = backend_of(options)
    timer = Timer(backend.name, options.repeats)
    steps = StepSizes(0.0025, 0.25, 0.05, 0.4, 0.08, (0.09, 0.09, 0.09))
    planes, degrees = some_rows(SCENES[options.scene] / "point_cloud.ply", options.rows, steps)
    count = len(degrees)
    with tempfile.TemporaryDirectory() as folder:
        path, ply = Path(folder) / "a.fgs", Path(folder) / "a.ply"
        grid, _ = to_grid(planes, degrees, steps, np.zeros(3))
        size = write_grid(path, grid, {})
        check(size == path.stat().st_size == sum(section.length for section in verify(path)), "bytes of the file")
        decompress(path, ply, device=options.device)
        back, expected = PlySource(ply), from_grid(grid)
        for name, plane in back.read(slice(0, count), list(FIELD)).items():
            check(np.array_equal(plane, expected[name]), f"{name} through file and PLY")
        del expected
        note = f"{count} Gaussians, {np.count_nonzero(degrees) / count:.0%} of them with SH; file and PLY checked"
        timer.add("codec: size", [8 * size / count], "bits/Gaussian", note)
        sh = sum(bytes_ for name, bytes_ in channel_bytes(path).items() if name.startswith("sh"))
        timer.add("codec: size of the SH", [8 * sh / count], "bits/Gaussian", note)

        def rate(label: str, run: Callable[[], Any]) -> None:
            wall, cpu = [], []
            for _ in range(options.repeats):
                start = time.perf_counter(), time.process_time()
                result = run()
                spared = result.run.startup_seconds + result.run.compile_seconds if hasattr(result, "run") else 0.0
                wall.append(count / (time.perf_counter() - start[0] - spared) / 1e6)
                cpu.append(count / (time.process_time() - start[1]) / 1e6)
            timer.add(label, wall, "M/s", f"{note}; by processor time {np.median(cpu):.3g} M/s")

        rate("codec: to grid", lambda: to_grid(planes, degrees, steps, np.zeros(3)))
        rate("codec: encode to a file", lambda: write_grid(path, grid, {}, force=True))
        rate("codec: bits", lambda: bit_model(grid, encode_grid(grid)))
        rate("codec: size", lambda: coded_size(grid, {}))
        rate("codec: positions only", lambda: GridSource(path).read(slice(0, count), ["means"]))
        rate("codec: decode", lambda: GridSource(path).grid())
        if backend.threads:
            check(
                write_grid(path, grid, {}, force=True, device=backend) == size, "bytes of the file coded on the device"
            )
            rate("codec: encode on the device", lambda: write_grid(path, grid, {}, force=True, device=backend))
            source = GridSource(path)
            with source.on_device(backend, source.threads):
                source.read(slice(0, 1), ["means"])  # the first launch builds kernels
                rate("codec: decode on the device", source.grid)
        rate("codec: file to PLY in NumPy", lambda: decompress(path, ply, force=True, device="numpy"))
        rate("codec: file to PLY", lambda: decompress(path, ply, force=True, device=options.device))


if __name__ == "__main__":
    main()
