"""The preview of a file: the same scene in far fewer Gaussians, which viewers show until the first layer is there.

A file with levels has a larger one, which has a preview of its own. In both, a layer stands for each chunk of the scene.

Gaussians are taken away in stages. After each stage, a descent moves those that are left towards pictures of the whole scene.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import GridContainer, write_grid
from flexgs_edge.constants import DILATION
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
LEVEL_SHARE, LEVEL_STAGES = 0.065, (2,)
"""The level between preview and scene: its share of the bytes, and its stages. With a preview it takes less than a tenth."""
STAGE, LAST_STAGE = Schedule(150, rate=2.0), Schedule(400, rate=2.0)
"""The descents. Rates are higher than usual, since there is a long way to go."""
KEPT = 0.5  # Share of the bits that stays in a stage before costs are measured again: docs/results/tuning.md#preview
COARSE = 2.0  # Step sizes of the preview's grid, as multiples of those of the whole scene's
POSES, POINTS = 128, 1 << 14  # Most poses, and about the most points that are looked at in each of them
TRIES, LESS = 3, 0.97
"""How often the last stage is made, each time with fewer Gaussians, until the size holds; and a margin for that."""


@dataclass(frozen=True)
class Part:
    """Some of a scene's Gaussians, without SH: stored planes ([width, n] f32 by field), and the layer of each ([n] u8)."""

    planes: Planes
    layer: np.ndarray

    @property
    def count(self) -> int:
        """Number of Gaussians."""
        return len(self.layer)


def make_preview(
    grid: GridScene,  # the whole scene
    sizes: Sequence[int],  # most bytes of the preview, then of its own preview
    bits: BitModel,  # bits of the scene's Gaussians
    renderer: Renderer,  # draws the views; with nothing loaded
    cameras: Sequence[Camera],  # the scored poses; a part of them decides
    settings: Mapping[str, Any],  # those of the scene's file; the preview is drawn like it
    progress: Progress = SILENT,  # told of each view
    chunk_rows: int | None = None,  # makes levels: rows of the chunks that layers stand for. Default: one layer
) -> bytes:
    """A file of at most so many bytes, without SH; no bytes if there is no room for one."""
    if grid.count == 0:
        return b""
    storage, previews = renderer.storage, []
    drawn = {name: settings[name] for name in DRAWING}
    planes = values_of(grid, storage)
    with References(storage.folder) as references:
        some = [_coarser(camera) for camera in cameras[:: -(-len(cameras) // POSES)]]
        if chunk_rows is not None:  # levels are seen from far away: smaller pictures count too
            some[::2] = [_farther(camera) for camera in some[::2]]
        original = _original(planes, grid.origin, references, renderer, some, progress)
        layer = (np.arange(grid.count) // (chunk_rows or grid.count)).astype(np.uint8)
        small = Part({**planes, "sh_rest": planes["sh_rest"][:0]}, layer)
        del planes
        for most in sizes:
            rows = 8 * most / bits.of_degree(0)
            for times in STAGES if chunk_rows is None else LEVEL_STAGES:
                small = _stage(small, times * rows, original, STAGE)
            coded = _fitting(small, most, original, grid, drawn)
            if coded is None:
                break
            previews.append(coded)
            small = coded.part
    file = b""
    for coded in reversed(previews):
        file = coded.written(file)
    return file


def _fitting(
    small: Part, most: int, original: Original, whole: GridScene, settings: Mapping[str, Any]
) -> _Coded | None:
    """As many Gaussians as `most` bytes hold, after the last stage."""
    storage = original.renderer.storage
    coded = _Coded(small, whole, settings, storage)
    for _ in range(TRIES):
        rows = coded.rows_in(most)
        if rows < 1:
            break
        coded = _Coded(_stage(small, rows, original, LAST_STAGE, whole.step_sizes), whole, settings, storage)
        if coded.size <= most:
            return coded
    return None


class _Coded:
    """A part of a scene on a coarser grid than that of the whole.

    `whole`: the whole scene. `settings`: of the file. `storage`: holds the grid.
    """

    def __init__(self, part: Part, whole: GridScene, settings: Mapping[str, Any], storage: Storage) -> None:
        self.part, self._settings = part, settings
        steps = holdable(_coarse(whole.step_sizes), part.planes)
        degrees = np.zeros(part.count, np.uint8)
        self._grid = to_grid(part.planes, degrees, steps, whole.origin, part.layer, storage)[0]
        self.size = len(self.written())

    def written(self, preview: bytes = b"") -> bytes:
        """Its file, with a preview of its own or without."""
        with tempfile.TemporaryDirectory() as folder:
            place = Path(folder) / "preview.fgs"
            write_grid(place, self._grid, self._settings, preview=preview, boxes=False)
            header = GridContainer(place).header
            self._overhead = header.chunks_offset + header.table_bytes
            return place.read_bytes()

    def rows_in(self, size: int) -> float:
        """About how many rows fit into a file of `size` bytes."""
        share = (size - self._overhead) / (self.size - self._overhead)
        return float(LESS * share * self.part.count)


def _original(
    planes: Planes,
    origin: np.ndarray,
    references: References,
    renderer: Renderer,
    cameras: Sequence[Camera],
    progress: Progress,
) -> Original:
    """The whole scene from some poses."""
    with renderer.load(MemorySource(planes, origin=origin)) as scene:
        for view, camera in enumerate(renderer.in_turn(scene, cameras)):
            references.add(view, renderer.render_planes(scene, camera))
    depth = usual_depth(renderer, MemorySource(planes, origin=origin), cameras)
    return Original(renderer, origin, cameras, references, progress=progress, depth=depth)


def _farther(camera: Camera) -> Camera:
    """The view of `_coarser` as a picture of its own pixels, in which Gaussians are as wide as in any."""
    return replace(camera, dilation=DILATION)


def _coarser(camera: Camera) -> Camera:
    """Some points of a view."""
    step = math.floor(math.sqrt(camera.width * camera.height / POINTS) / STEP_UNIT) * STEP_UNIT
    return camera.every(step) if step > 1 else camera


def _stage(
    part: Part, rows: float, original: Original, schedule: Schedule, step_sizes: StepSizes | None = None
) -> Part:
    """About `rows` rows of a part, as large as they have to be, and moved by a descent."""
    renderer, count, planes = original.renderer, part.count, part.planes
    degrees = np.zeros(count, np.uint8)
    share, cameras = min(rows / count, 1.0), original.cameras
    left = worthiest(
        planes, degrees, np.arange(count), share, BitModel(), renderer, cameras, original.origin, keep=KEPT
    )
    left = np.sort(left)
    kept = take_rows(planes, left, renderer.storage)
    kept["log_scales"] += growth(len(left), count)
    steps = None if step_sizes is None else holdable(_coarse(step_sizes), kept)
    return Part(finetune(kept, degrees[left], original, schedule, steps), part.layer[left])


def _coarse(steps: StepSizes) -> StepSizes:
    """Step sizes of a preview: coarser, and none of SH."""
    geometry = {name: COARSE * getattr(steps, name) for name in ("position", "scale", "rotation", "opacity", "dc")}
    return replace(steps, **geometry, sh=())
