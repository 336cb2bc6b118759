"""Quantization step sizes of equal slope: the last bit of every kind of value buys the same squared error.

For a fine grid of step size d the squared error is s d^2, and n values cost -n log2 d bits. A multiplier (squared error
that a bit is worth) therefore asks for d = sqrt(multiplier * n / (2 ln 2 * s)). For colours s follows from the weights.
For geometry it is measured: one kind of value at a time is moved as a trial grid would move it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import CODE_LIMIT, SH_C0
from flexgs_edge.grid.step_sizes import POSITION_BITS, StepSizes
from flexgs_edge.memory.rows import put_rows, read_ahead
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.rotations import tilted, turned
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import to_half

GEOMETRY = {
    "position": ("means", 3), "scale": ("log_scales", 3), "rotation": ("quats", 3), "opacity": ("opacity_logits", 1),
}  # fmt: skip
"""Kinds of values: the field of each, and its coded values for a Gaussian."""
CHROMA = 2.0
"""Step sizes of Co and Cg in step sizes of Y. The squared error in red, green and blue is 3 dY^2 + dCo^2 / 2 + 3/4 dCg^2.
So equal slopes ask for sqrt(6) and 2."""
COARSEST = 2.0**70
"""Largest step size; the format ends at 2^80. A size that hardly holds the header asks for larger ones."""


@dataclass(frozen=True)
class Slopes:
    """How fast errors grow with step sizes of geometry."""

    # Squared error over squared step size and row, by kind of geometry, summed over pixels, three channels and all
    # scored poses.
    per_row: dict[str, float]

    def step(self, kind: str, multiplier: float) -> float:
        """The step size of `kind` for a multiplier."""
        slope = max(self.per_row[kind], 1e-30)
        return min(math.sqrt(multiplier * GEOMETRY[kind][1] / (2 * math.log(2) * slope)), COARSEST)


def probe_slopes(
    renderer: Renderer, planes: dict[str, np.ndarray], origin: np.ndarray, cameras: Sequence[Camera], most: int
) -> Slopes:
    """Measure the slopes of the geometry; the scene is drawn five times from at most `most` poses.

    `renderer`: with nothing loaded. `planes`: stored planes ([width, n] f32 by field); not changed. `origin`: [3] f64, as in
    `SceneSource`. `cameras`: all scored poses; those to draw from are evenly spread among them.
    """
    count, some = planes["means"].shape[1], min(most, len(cameras))
    views = [cameras[i * len(cameras) // some] for i in range(some)]
    with renderer.load(MemorySource(planes, origin=origin)) as scene:
        reference = [to_half(renderer.render(scene, camera)) for camera in renderer.in_turn(scene, views)]
    smallest = np.concatenate([scales.min(axis=0) for _, (scales,) in read_ahead(count, planes["log_scales"])])
    size = float(np.exp(np.median(smallest.astype(np.float64))))
    # Small enough that squared errors grow with squared steps; large enough to exceed the rounding of half precision.
    trial = {"position": size / 4, "scale": 0.1, "rotation": 0.03, "opacity": 0.2}
    per_row = {}
    fields = [field for field, _ in GEOMETRY.values()]
    for kind, (field, _) in GEOMETRY.items():
        moved = {**planes, field: renderer.storage.empty(planes[field].shape, np.float32)}
        for rows, found in read_ahead(count, *(planes[name] for name in fields)):
            part = dict(zip(fields, found, strict=True))
            put_rows(moved[field], rows, _on_trial_grid(part, kind, np.float32(trial[kind])))
        with renderer.load(MemorySource(moved, origin=origin)) as scene:
            images = map(partial(renderer.render, scene), renderer.in_turn(scene, views))
            pairs = zip(images, reference, strict=True)
            errors = (np.square(image - drawn.astype(np.float32), dtype=np.float64) for image, drawn in pairs)
            error = sum(float(squares.sum()) for squares in errors)
        per_row[kind] = error * len(cameras) / len(views) / (count * trial[kind] ** 2)
    return Slopes(per_row)


def _on_trial_grid(planes: dict[str, np.ndarray], kind: str, step: np.float32) -> np.ndarray:
    """The field that changes when values of one kind are rounded to multiples of `step`.

    Only opacities are rounded. Other values get errors of the same mean square, along and about each Gaussian's own axes,
    with signs from the digits of its opacity. A real grid would begin at a place that depends on the scene's unit and
    axes. The errors of a few large Gaussians would depend on it too, and so would the slopes. All errors have one size,
    so it matters little which Gaussian gets which sign.
    """
    if kind != "opacity":
        digits = planes["opacity_logits"][0].view(np.uint32).astype(np.uint64) * np.uint64(0x9E3779B97F4A7C15)
        first = {"position": 61, "scale": 58, "rotation": 55}[kind]
        places = np.arange(first, first + 3, dtype=np.uint64)[:, None]
        errors = np.where(digits >> places & np.uint64(1), -1.0, 1.0) * float(step) / math.sqrt(12)
        if kind == "scale":
            return (planes["log_scales"] + errors).astype(np.float32)
        if kind == "rotation":
            # Mean square error of a rotation over that of its three stored components. The fourth component follows from these,
            # so its error adds up: the mean of 1 + |xyz|^2 / (3 w^2) over random rotations in their canonical form.
            return tilted(planes["quats"], errors * math.sqrt(1.051)).astype(np.float32)
        moved: np.ndarray = (planes["means"] + turned(planes["quats"], errors)).astype(np.float32)
        return moved
    return (np.rint(planes["opacity_logits"] / step) * step).astype(np.float32)


def choose_steps(
    slopes: Slopes, weight2: np.ndarray, degrees: np.ndarray, sh_degree: int, multiplier: float
) -> StepSizes:
    """Step sizes of every kind of value for a multiplier.

    `weight2`: [n] f64, sums of squared weights of the kept Gaussians: an error e of a coefficient in luma costs 3 w2 (Y e)^2.
    `degrees`: [n] u8, SH degree kept. `sh_degree`: of the scene. `multiplier`: squared error that a bit is worth.
    """

    def colour(rows: np.ndarray) -> float:
        # Uniform error of variance d^2 / 12; the mean of Y_k^2 over directions is Y_0^2 for every k.
        slope = 3 * SH_C0**2 * max(float(rows.sum()), 1e-30) / 12
        return min(math.sqrt(multiplier * max(len(rows), 1) / (2 * math.log(2) * slope)), COARSEST)

    bands = tuple(colour(weight2[degrees >= max(level, 1)]) for level in range(1, sh_degree + 1))
    geometry: dict[str, Any] = {kind: slopes.step(kind, multiplier) for kind in GEOMETRY}
    return StepSizes(**geometry, dc=colour(weight2), sh=bands, chroma=CHROMA)


def reachable(steps: StepSizes, planes: dict[str, np.ndarray], seen: np.ndarray) -> np.ndarray:
    """[n] bool: rows that some pose sees, and all others that a grid of these step sizes can hold too.

    Without this, one Gaussian far away and in no view could ask for position steps as large as the scene itself:
    docs/results/stability.md

    `steps`: as chosen. `seen`: [n] bool, rows that some pose sees. `holdable` makes steps coarser for them.
    """
    if not seen.any():
        return np.ones(len(seen), bool)
    means, count = planes["means"], len(seen)
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for rows, (part,) in read_ahead(count, means):
        some = part[:, seen[rows]].astype(np.float64)
        low, high = (
            np.minimum(low, some.min(axis=1, initial=np.inf)),
            np.maximum(high, some.max(axis=1, initial=-np.inf)),
        )
    storage = max((2**POSITION_BITS - 2) * steps.position, float((high - low).max()))
    limits = {
        "log_scales": (CODE_LIMIT - 2) * steps.scale,
        "opacity_logits": (CODE_LIMIT - 2) * steps.opacity,
        "sh_dc": CODE_LIMIT // 4 * steps.dc,
    }
    every = seen.copy()
    for rows, (part, *others) in read_ahead(count, means, *(planes[name] for name in limits)):
        inside = np.abs(part.astype(np.float64) - (low + high)[:, None] / 2).max(axis=0) <= storage / 2
        for values, most in zip(others, limits.values(), strict=True):
            inside &= np.abs(values).max(axis=0) <= most
        every[rows] |= inside
    return every
