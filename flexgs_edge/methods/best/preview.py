"""The preview of a file: the same scene in far fewer Gaussians, which viewers show until the first layer is there.

Gaussians are taken away in stages. After each stage, a descent moves those that are left towards pictures of the whole scene.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import GridContainer, write_grid
from flexgs_edge.grid.grid_scene import GridScene, values_of
from flexgs_edge.grid.step_sizes import StepSizes, holdable
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.memory.storage import Storage
from flexgs_edge.methods.best.allocation import BitModel
from flexgs_edge.methods.best.effort import STEP_UNIT
from flexgs_edge.methods.best.layers import worthiest
from flexgs_edge.methods.best.refit.finetune import Schedule, finetune
from flexgs_edge.methods.best.rounds import take_rows
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.few_poses import usual_depth
from flexgs_edge.scene.source import MemorySource, Planes, growth
from flexgs_edge.views.references import Original, References

LEAST_PREVIEWED, PREVIEW_SHARE = 1_000_000, 0.02
"""Where nothing is said, files from so many bytes on get a preview, of this share of their bytes. A smaller file comes within a
second over 10 Mbit/s: docs/results/tuning.md#preview"""
DRAWING = "near", "background", "extent", "antialiased"  # Settings that say how a file is drawn
STAGES = 8, 4, 2
"""How many times as many Gaussians each stage leaves as the last one, which comes behind: docs/results/tuning.md#preview"""
STAGE, LAST_STAGE = Schedule(150, rate=2.0), Schedule(500, rate=2.0)
"""The descents. Rates are higher than usual, since there is a long way to go."""
KEPT = 0.5  # Share of the bits that stays in a stage before costs are measured again: docs/results/tuning.md#preview
COARSE = 2.0  # Step sizes of the preview's grid, as multiples of those of the whole scene's
POSES, POINTS = 128, 1 << 14  # Most poses, and about the most points that are looked at in each of them
TRIES, LESS = 3, 0.95
"""How often the last stage is made, each time with fewer Gaussians, until the size holds; and a margin, so that once is enough:
the fewer Gaussians, the more bytes each takes, 1 to 5 % in a stage: docs/results/tuning.md#preview"""


def default_bytes(size: int) -> int:
    """Bytes of the preview that a file of `size` bytes has where nothing is said; 0 for none."""
    return int(PREVIEW_SHARE * size) if size >= LEAST_PREVIEWED else 0


def make_preview(
    grid: GridScene,  # the whole scene
    most: int,  # bytes of the preview
    bits: BitModel,  # bits of the scene's Gaussians
    renderer: Renderer,  # draws the views; with nothing loaded
    cameras: Sequence[Camera],  # the scored poses; a part of them decides
    settings: Mapping[str, Any],  # those of the scene's file; the preview is drawn like it
    progress: Progress = SILENT,  # told of each view
) -> bytes:
    """A file of at most `most` bytes, without SH; no bytes if there is no room for one."""
    if grid.count == 0:
        return b""
    storage = renderer.storage
    drawn = {name: settings[name] for name in DRAWING}
    planes = values_of(grid, storage)
    with References(storage.folder) as references:
        original = _original(planes, grid.origin, references, renderer, cameras, progress)
        small = {**planes, "sh_rest": planes["sh_rest"][:0]}
        del planes
        rows = 8 * most / bits.of_degree(0)
        for times in STAGES:
            small = _stage(small, times * rows, original, STAGE)
        coded = _Coded(small, grid, drawn, storage)
        for _ in range(TRIES):
            rows = coded.rows_in(most)
            if rows < 1:
                break
            made = _stage(small, rows, original, LAST_STAGE, grid.step_sizes)
            coded = _Coded(made, grid, drawn, storage)
            if len(coded.file) <= most:
                return coded.file
    return b""


class _Coded:
    """A file of some planes without SH, on a coarser grid than that of the whole scene.

    `planes`: stored planes ([width, n] f32 by field). `whole`: the whole scene. `settings`: of the file. `storage`:
    holds the grid.
    """

    def __init__(self, planes: Planes, whole: GridScene, settings: Mapping[str, Any], storage: Storage) -> None:
        self.count = planes["means"].shape[1]
        steps = holdable(_coarse(whole.step_sizes), planes)
        grid = to_grid(planes, np.zeros(self.count, np.uint8), steps, whole.origin, storage=storage)[0]
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "preview.fgs"
            write_grid(place, grid, settings)
            self.file = place.read_bytes()
            header = GridContainer(place).header
        self.overhead = header.chunks_offset + header.table_bytes

    def rows_in(self, size: int) -> float:
        """About how many rows fit into a file of `size` bytes."""
        share = (size - self.overhead) / (len(self.file) - self.overhead)
        return float(LESS * share * self.count)


def _original(
    planes: Planes,
    origin: np.ndarray,
    references: References,
    renderer: Renderer,
    cameras: Sequence[Camera],
    progress: Progress,
) -> Original:
    """The whole scene from a part of the poses, at a part of their points."""
    some = [_coarser(camera) for camera in cameras[:: -(-len(cameras) // POSES)]]
    with renderer.load(MemorySource(planes, origin=origin)) as scene:
        for view, camera in enumerate(renderer.in_turn(scene, some)):
            references.add(view, renderer.render_planes(scene, camera))
    depth = usual_depth(renderer, MemorySource(planes, origin=origin), some)
    return Original(renderer, origin, some, references, progress=progress, depth=depth)


def _coarser(camera: Camera) -> Camera:
    step = math.floor(math.sqrt(camera.width * camera.height / POINTS) / STEP_UNIT) * STEP_UNIT
    return camera.every(step) if step > 1 else camera


def _stage(
    planes: Planes, rows: float, original: Original, schedule: Schedule, step_sizes: StepSizes | None = None
) -> Planes:
    """About `rows` rows of the planes, which have no SH, as large as they have to be, and moved by a descent."""
    renderer, count = original.renderer, planes["means"].shape[1]
    degrees = np.zeros(count, np.uint8)
    part, cameras = min(rows / count, 1.0), original.cameras
    left = worthiest(planes, degrees, np.arange(count), part, BitModel(), renderer, cameras, original.origin, keep=KEPT)
    kept = take_rows(planes, np.sort(left), renderer.storage)
    kept["log_scales"] += growth(len(left), count)
    steps = None if step_sizes is None else holdable(_coarse(step_sizes), kept)
    return finetune(kept, degrees[left], original, schedule, steps)


def _coarse(steps: StepSizes) -> StepSizes:
    """Step sizes of a preview: coarser, and none of SH."""
    geometry = {name: COARSE * getattr(steps, name) for name in ("position", "scale", "rotation", "opacity", "dc")}
    return replace(steps, **geometry, sh=())
