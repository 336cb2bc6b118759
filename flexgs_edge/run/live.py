"""The live scenes of a report: the file that was made, and the original on a fine grid."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import numpy as np

from flexgs_edge.codec.open_fgs import file_version
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.grid.step_sizes import StepSizes, position_grid
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.report.material import Live
from flexgs_edge.run.inputs import Options
from flexgs_edge.run.run import Run
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import format_size
from flexgs_edge.viewer.assets import LIVE, web_files
from flexgs_edge.viewer.join import join_modules
from flexgs_edge.viewer.scene_page import page_config

SCENE_MOST = 8_000_000  # Most bytes of a scene in a report; it takes a third more there
ROWS_MOST = 400_000  # Most Gaussians of an original: more do not fit into that
ROW_BYTES = 59 * 4 * 4  # Memory that coding takes for a Gaussian: its values, their forms and codes


def live_scenes(run: Run[Options], path: str | os.PathLike[str], first: int) -> Live:
    """What the live scenes of a report need."""
    look = {"near": run.options.near, "background": run.options.background, "antialiased": run.options.antialiased}
    config = {**page_config("", run.seen.cameras, look), "first": first}
    size = os.stat(path).st_size
    if size > SCENE_MOST:
        return Live("", config, None, None, f"The file, {format_size(size)}, is too large for this page")
    original, note = _original(run)
    return Live(join_modules(web_files(file_version(path)), LIVE), config, Path(path).read_bytes(), original, note)


def _original(run: Run[Options]) -> tuple[bytes | None, str]:
    """The original as a `.fgs`, or why it is not there."""
    source = run.source
    large = "The original is too large for this page"
    if source.count > ROWS_MOST:
        return None, large
    if run.budget.free < source.count * ROW_BYTES:
        return None, "The memory limit leaves no room for coding the original for this page"
    with tempfile.TemporaryDirectory(prefix="flexgs-live-") as folder:
        place = Path(folder) / "original.fgs"
        if _write_fine(source, place) > SCENE_MOST:
            return None, large
        return place.read_bytes(), ""


def _write_fine(source: SceneSource, place: Path) -> int:
    """Code a scene so finely that its pictures are those of the scene; returns the bytes."""
    planes = source.read(slice(0, source.count), list(FIELD))
    degrees = np.full(source.count, source.sh_degree, np.uint8)
    steps = fine_steps(planes["means"], planes["log_scales"], source.sh_degree)
    grid, _ = to_grid(planes, degrees, steps, source.origin)
    return write_grid(place, grid, {})


def fine_steps(means: np.ndarray, log_scales: np.ndarray, sh_degree: int) -> StepSizes:
    """Step sizes whose errors nobody sees; of positions, a sixteenth of the size of a small Gaussian.

    `means`, `log_scales`: [3, n] f32.
    """
    small = float(np.exp(np.percentile(log_scales.max(axis=0), 10)))
    position, contraction = position_grid(means, max(small / 16, 2.0**-70))
    return StepSizes(position, 0.025, 0.005, 0.05, 0.01, (0.015,) * sh_degree, contraction=contraction)
