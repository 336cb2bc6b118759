"""Self-distillation: a short descent of all kept values towards the original's own renders (no photos, nothing is added)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from flexgs_edge.cameras import Camera
from flexgs_edge.grid import Steps
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render import DeviceScene, Renderer, sum_bytes
from flexgs_edge.render.device_scene import Chunk
from flexgs_edge.render.renderer import GRADIENT_SUMS
from flexgs_edge.render.targets import TargetViews
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource

ORDER = ("means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest")
"""Fields in the order of a gradient's planes (cl_kernels/backward.cl)."""
DECAYS = (0.9, 0.99)
FIELD_RATES = {
    "log_scales": 5e-3, "quats": 1e-3, "opacity_logits": 2.5e-2, "sh_dc": 2.5e-3, "sh_rest": 1.25e-4,
}  # fmt: skip
MEANS_RATE = 1.6e-4
LAST = 0.1


@dataclass(frozen=True)
class Plan:
    steps: int
    rate: float = 1.0
    last: float = LAST
    seed: int = 0


def extent_of(cameras: Sequence[Camera]) -> float:
    """1.1 times the largest distance of a camera from their mean, as in the reference program."""
    centres = np.stack([camera.center for camera in cameras])
    return 1.1 * float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())


class _Part:
    """Values, gradients and running means of one chunk."""

    def __init__(self, scene: DeviceScene, chunk: Chunk, planes: dict[str, np.ndarray], degrees: np.ndarray) -> None:
        backend, self.chunk, self.arrays = scene.backend, chunk, []
        self.backend = backend
        self.widths = {name: FIELD[name].width(chunk.degree) for name in ORDER}
        self.planes = sum(self.widths.values())
        rows = slice(chunk.base, chunk.base + chunk.count)
        stride = chunk.stride
        self.values, self.first, self.second, self.gradient = (self._array((self.planes, stride)) for _ in range(4))
        self.powers, self.touched = self._array((2, stride)), self._array((stride,))
        self.degrees = self._array((stride,), np.uint32)
        self.log_scales, self.quats, self.logits = (self._array((n, stride)) for n in (3, 4, 1))
        for array in (self.values, self.first, self.second):
            backend.fill(array, 0)
        backend.write(self.powers, np.ones((2, stride), np.float32))
        padded = np.zeros(stride, np.uint32)
        padded[: chunk.count] = degrees[rows]
        backend.write(self.degrees, padded)
        at = 0
        for name in ORDER:
            own = planes[name]
            if name == "sh_rest":
                own = own.reshape(3, -1, own.shape[1])[:, : self.widths[name] // 3].reshape(self.widths[name], -1)
            for channel in range(self.widths[name]):
                backend.write(self.values, own[channel, rows], (at + channel) * stride)
            at += self.widths[name]

    def _array(self, shape: tuple[int, ...], dtype: Any = np.float32) -> Any:
        made = self.backend.array(shape, dtype)
        self.arrays.append(made)
        return made

    def snap(self, steps: Any, antialiased: bool) -> None:
        c = self.chunk
        self.backend.launch(
            "snap", (c.stride,), c.stride, c.degree, steps, self.values, c.means, self.log_scales, self.quats, self.logits,
            c.sh_dc, c.sh_rest,
        )  # fmt: skip
        self.backend.launch(
            "activate", (c.stride,), c.stride, int(antialiased), self.log_scales, self.quats, self.logits, c.cov, c.log2_opacity
        )

    def descend(self, renderer: Renderer, antialiased: bool, sums: Any, rates: Any) -> None:
        c = self.chunk
        self.backend.launch(
            "project_backward", (c.stride,), c.count, c.stride, c.base, c.degree, int(antialiased), renderer.camera_array, c.means,
            self.log_scales, self.quats, self.logits, c.sh_rest, self.degrees, renderer.records_array, sums, self.touched,
            self.gradient,
        )  # fmt: skip
        self.backend.launch(
            "adam", (c.stride,), c.stride, self.planes, *DECAYS, rates, self.touched, self.gradient, self.powers, self.first,
            self.second, self.values,
        )  # fmt: skip

    def release(self):
        for a in self.arrays:
            a.release()
        self.arrays = []


def step_record(steps: Steps | None) -> np.ndarray:
    record = np.zeros(14, np.float32)
    if steps is not None:
        record[:4] = steps.position, steps.scale, steps.rotation, steps.opacity
        for k, luma in enumerate((steps.dc, *steps.sh)):
            record[4 + 2 * k : 6 + 2 * k] = steps.colour(luma)[:2]
    return record


def distil(
    renderer: Renderer,
    planes: dict[str, np.ndarray],
    degrees: np.ndarray,
    origin: np.ndarray,
    cameras: Sequence[Camera],
    targets: TargetViews,
    plan: Plan,
    steps: Steps | None = None,
    rates: dict | None = None,
    progress: Progress = SILENT,
    snap_from: int = 0,
) -> dict[str, np.ndarray]:
    source = MemorySource(planes, origin=origin)
    room = sum_bytes(GRADIENT_SUMS) + 4 * (4 * sum(FIELD[n].width(source.sh_degree) for n in ORDER) + 12)
    extent = extent_of(cameras)
    table = {"means": MEANS_RATE * extent, **FIELD_RATES, **(rates or {})}
    rng = np.random.default_rng(plan.seed)
    order = np.concatenate([rng.permutation(len(cameras)) for _ in range(-(-plan.steps // len(cameras)))])[: plan.steps]
    backend = renderer.backend
    parts = []
    with renderer.load(source, room, targets=True) as scene:
        renderer.gradient_sums(scene, cameras[int(order[0])], targets[int(order[0])])
        assert scene.resident
        parts = [_Part(scene, c, planes, degrees) for c in scene.chunks()]
        base = np.concatenate([np.full(n, table[name]) for name, n in parts[0].widths.items()])
        rate_array, grid_array = backend.array((len(base),), np.float32), backend.array((14,), np.float32)
        try:
            for k, view in enumerate(progress.track(order, "distilling", len(order))):
                if k in (0, snap_from):
                    backend.write(grid_array, step_record(steps if k >= snap_from else None))
                    for p in parts:
                        p.snap(grid_array, renderer.antialiased)
                sums = renderer.gradient_sums(scene, cameras[int(view)], targets[int(view)])
                now = plan.rate * plan.last ** (k / plan.steps)
                backend.write(rate_array, (base * now).astype(np.float32))
                for p in parts:
                    p.descend(renderer, renderer.antialiased, sums, rate_array)
                    p.snap(grid_array, renderer.antialiased)
            out = {n: np.array(planes[n]) for n in ORDER}
            for p in parts:
                values = backend.read(p.values)
                at = 0
                for name in ORDER:
                    own = out[name].reshape(3, -1, source.count)[:, : p.widths[name] // 3] if name == "sh_rest" else out[name]
                    part = values[at : at + p.widths[name], : p.chunk.count]
                    own[..., p.chunk.base : p.chunk.base + p.chunk.count] = part.reshape(*own.shape[:-1], -1)
                    at += p.widths[name]
            return out
        finally:
            for p in parts:
                p.release()
            rate_array.release()
            grid_array.release()
