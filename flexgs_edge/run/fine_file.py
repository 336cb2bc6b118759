"""Write a `.fgs` of a large scene that was never compressed, for the viewer: a few seconds for a million Gaussians."""

from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.codec.v2.container import FEWEST, write_grid
from flexgs_edge.codec.v2.header import CHUNK_ROWS
from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.grid.step_sizes import StepSizes, holdable
from flexgs_edge.grid.to_grid import lowered, to_grid
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.tested import counted_backend
from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.progress import LOG
from flexgs_edge.run.decoding import coding_device
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import GrownSource, Planes, SceneSource, growth, read_all
from flexgs_edge.units import format_size

LEAST_FINE = FEWEST * CHUNK_ROWS  # Gaussians from which a file tells where its chunks lie
VALUE_BYTES = 16  # Bytes of memory for each value of a scene: as it is, in order, as a code, and as a symbol
NEIGHBOURS = 32  # One Gaussian of the preview stands for so many of the scene
MOST_PREVIEWED = 1 << 18  # Most Gaussians of a preview: about 3 MB


def write_fine(path: Path, run: Run[Any], settings: Mapping[str, Any]) -> bool:
    """Write the scene of a run as a file of version 2 with a preview, so that a viewer loads what is in sight first.

    Of a scene that memory does not hold, an even part of the Gaussians is written, drawn larger. Returns False, and writes
    nothing, if the scene is small, or without the device or the memory for it.
    """
    source: SceneSource = run.source
    row_bytes = VALUE_BYTES * sum(field.width(source.sh_degree) for field in FIELD.values())
    device = _coder(run) if source.count >= LEAST_FINE else None
    most = run.budget.free // row_bytes
    if device is None or most < LEAST_FINE:
        return False
    if source.count > most:
        enough = format_size(run.budget.limit + (source.count - most) * row_bytes)
        LOG.warning(
            "warning: %d of %d Gaussians are shown, larger: --memory-limit %s shows all", most, source.count, enough
        )
        source = GrownSource(source.select(np.arange(most) * source.count // most), source.count)
    planes = read_all(source, IN_MEMORY)
    steps = holdable(fine_steps(planes, source.sh_degree), planes)
    grid, order = to_grid(planes, np.full(source.count, source.sh_degree, np.uint8), steps, source.origin)
    few = heaviest(planes, order, max(NEIGHBOURS, -(-source.count // MOST_PREVIEWED)))
    del planes, order
    small, _ = to_grid(few, np.zeros(few["means"].shape[1], np.uint8), holdable(steps, few), source.origin)
    preview = path.with_name("preview.fgs")
    write_grid(preview, small, settings, device=device, boxes=False)
    write_grid(path, lowered(grid), settings, device=device, preview=preview.read_bytes())
    return True


def fine_steps(planes: Planes, sh_degree: int) -> StepSizes:
    """Step sizes by which a scene looks as it is: about 50 dB."""
    width = float(np.exp(np.median(planes["log_scales"].min(axis=0))))
    return StepSizes(position=width / 8, scale=0.03, rotation=0.005, opacity=0.05, dc=0.008, sh=(0.01,) * sh_degree)


def heaviest(planes: Planes, order: np.ndarray, size: int) -> Planes:
    """Of each `size` rows that follow each other in `order` ([n] i64), the one that holds back most light, larger, without SH."""
    groups = order[: len(order) // size * size].reshape(-1, size)
    longest = planes["log_scales"].sum(axis=0) - planes["log_scales"].min(axis=0)
    light = (longest - np.logaddexp(0, -planes["opacity_logits"][0]))[groups]
    kept = np.sort(np.take_along_axis(groups, light.argmax(axis=1)[:, None], axis=1)[:, 0])
    few = {name: values[:, kept] for name, values in planes.items()}
    few["sh_rest"], few["log_scales"] = few["sh_rest"][:0], few["log_scales"] + growth(len(kept), len(order))
    return few


def _coder(run: Run[Any]) -> Backend | None:
    """What codes the scene; None where NumPy would have to, which takes a minute for a million Gaussians."""
    with suppress(BudgetError, DeviceError):
        backend = counted_backend(run.options.device, run.budget, run.clock)
        return coding_device(backend, run.budget, run.source.count, run.source.sh_degree)
    return None
