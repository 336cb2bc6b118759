"""Experiment on stray values: a few Gaussians that no camera sees, with values far from all others."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.grid.values import from_grid
from flexgs_edge.methods.best.choose_steps import holdable, reachable
from flexgs_edge.methods.best.rounds import take_rows
from flexgs_edge.methods.paper.evaluator import Ranked, SceneEvaluator
from flexgs_edge.packed.bitspec import PAPER, BitSpec
from flexgs_edge.report.plots import BarChart
from flexgs_edge.scene.fields import FIELD, FIELDS
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Table, columns
from flexgs_edge.studies.stability.amounts import Amounts
from flexgs_edge.studies.stability.baselines import tensor_rounded
from flexgs_edge.studies.stability.breaks import BREAK, LOSSES, Outcome, of_choice, of_source, where_it_breaks
from flexgs_edge.studies.stability.ours import Whole
from flexgs_edge.studies.study_scene import StudyScene

BITS = 8
METHODS = ("RTN, per tensor", "RTN, per channel", "RTN, sub-groups", "paper (MPQ)", "best")
DIRECTIONS = 256
MARGIN = 1.5
"""Least distance of strays from the middle of every frame, in half widths and half heights."""
AGAINST = {"log_scales": -1.0}
"""Signs of stray values by field, otherwise +1. Huge splats would show in every view, so stray scales are tiny. Quaternions are
coded at unit length, so none can stray."""


def unseen_direction(cameras: Sequence[Camera], middle: np.ndarray, distance: float) -> np.ndarray | None:
    """[3] f64, a direction in which no view shows a point at `distance` from `middle`; None if there is no such direction."""
    directions: list[np.ndarray] = list(fibonacci(DIRECTIONS))
    for direction in directions:
        place = middle + distance * direction
        if not any(_in_view(camera, place) for camera in cameras):
            return direction
    return None


def _in_view(camera: Camera, place: np.ndarray) -> bool:
    x, y, z = camera.rotation @ place + camera.translation
    if z <= 0:
        return False
    across = abs(camera.fx * x / z + camera.cx - camera.width / 2) < MARGIN * camera.width / 2
    return bool(across and abs(camera.fy * y / z + camera.cy - camera.height / 2) < MARGIN * camera.height / 2)


def strays_of(planes: dict[str, np.ndarray], size: float, direction: np.ndarray) -> dict[str, np.ndarray]:
    """One stray for each field but quaternions. It has the scene's medians, except for a far position and its stray field.

    Parameters
    ----------
    planes : dict
        Stored planes of the scene ([width, n] f32 by field).
    size : float
        Distance of the stray values, in standard deviations of each channel.
    direction : np.ndarray
        [3], where no camera looks.
    """
    astray = [field.name for field in FIELDS if field.name not in ("means", "quats") and len(planes[field.name])]
    count = 1 + len(astray)
    made = {}
    for name, values in planes.items():
        middle, spread = np.median(values, axis=1), values.std(axis=1, dtype=np.float64)
        made[name] = np.repeat(middle[:, None], count, axis=1).astype(np.float64)
        if name == "means":
            made[name] += (size * spread.max() * direction)[:, None]
        elif name == "quats":
            made[name][:] = np.array([1.0, 0.0, 0.0, 0.0])[:, None]
        elif name in astray:
            made[name][:, 1 + astray.index(name)] += AGAINST.get(name, 1.0) * size * np.maximum(spread, 1e-6)
    return {name: values.astype(np.float32) for name, values in made.items()}


def strays(studied: StudyScene, ours: Whole, amounts: Amounts) -> Experiment:
    """Compare quantizers with and without strays. Strays are coded, but no view shows them."""
    source = studied.run.source
    planes = source.read(slice(0, source.count), list(FIELD))
    cameras = [camera.moved(source.origin) for camera in studied.views.cameras]
    rows: list[dict[str, Cell]] = []
    hidden = True
    for size in amounts.outliers:
        added: dict[str, np.ndarray] | None = None
        if size:
            far = size * float(planes["means"].std(axis=1, dtype=np.float64).max())
            direction = unseen_direction(cameras, np.median(planes["means"], axis=1), far)
            hidden &= direction is not None
            added = strays_of(planes, size, np.array([0.0, 0.0, 1.0]) if direction is None else direction)
        for method, found in _coded(studied, ours, planes, added):
            rows.append({"method": method, "spreads": size, **found.cells(studied)})
    table = Table(columns(method="method", spreads="strays, in spreads", **LOSSES), tuple(rows))
    parts = {method: [row for row in rows if row["method"] == method] for method in METHODS}
    note = "" if hidden else " Cameras look all around here: the strays are in some views."
    return Experiment(
        "strays",
        "Stray values",
        f"{len(strays_of(planes, 1.0, np.zeros(3))['means'][0])} Gaussians are added where no camera looks, each "
        "with one attribute far from all others, by so many standard deviations, and a position as far from the "
        f"scene. RTN with {BITS} bits and the paper's bits, nothing removed; best with the rows that it keeps and "
        "the strays. Losses are over views that show no strays." + note,
        table,
        BarChart(
            "A few stray values, and what they cost all others",
            f"loss: {studied.plan.figure} (dB)",
            ["none" if not size else f"{size:g} spreads" for size in amounts.outliers],
            {method: [row["loss"] for row in part] for method, part in parts.items()},  # type: ignore[misc]
            limit=BREAK,
        ),
        tuple(
            where_it_breaks(
                part, method, lambda row: "no strays" if not row["spreads"] else f"strays of {row['spreads']:g} spreads"
            )
            for method, part in parts.items()
        ),
    )


def _coded(
    studied: StudyScene, ours: Whole, planes: dict[str, np.ndarray], added: dict[str, np.ndarray] | None
) -> list[tuple[str, Outcome]]:
    origin = studied.run.source.origin
    whole = planes if added is None else _joined(planes, added)
    source = MemorySource(whole, studied.run.source.sh_degree, origin)
    has_sh = np.concatenate([studied.has_sh, np.ones(source.count - len(studied.has_sh), bool)])

    def evaluator(bits: BitSpec, groups: int | None) -> SceneEvaluator:
        order = np.arange(source.count)
        return SceneEvaluator(Ranked(source, order, has_sh), bits, groups, studied.judge, studied.run.budget)

    rtn = BitSpec.rtn(BITS)
    return [
        (METHODS[0], of_source(studied, lambda: tensor_rounded(source, BITS))),
        (METHODS[1], of_choice(studied, lambda: evaluator(rtn, 1))),
        (METHODS[2], of_choice(studied, lambda: evaluator(rtn, None))),
        (METHODS[3], of_choice(studied, lambda: evaluator(PAPER, None))),
        (METHODS[4], of_source(studied, lambda: _best(ours, added))),
    ]


def _joined(planes: dict[str, np.ndarray], added: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Rows of both sets of planes. The second may have fewer channels."""
    return {name: np.concatenate([values, added[name][: len(values)]], axis=1) for name, values in planes.items()}


def _best(ours: Whole, added: dict[str, np.ndarray] | None) -> tuple[int, MemorySource]:
    """The rows that best kept, and the strays, which it keeps like all Gaussians that no pose sees."""
    if added is None:
        return ours.size, ours.source
    kept = from_grid(ours.grid)
    extra = len(added["means"][0])
    whole = _joined(kept, added)
    degrees = np.concatenate([ours.grid.sh_degrees, np.zeros(extra, np.uint8)])
    unseen = np.arange(len(degrees)) >= len(ours.grid.sh_degrees)
    keep = np.flatnonzero(reachable(ours.grid.step_sizes, whole, ~unseen))
    whole, degrees = take_rows(whole, keep), degrees[keep]
    grid, _ = to_grid(whole, degrees, holdable(ours.grid.step_sizes, whole), ours.grid.origin)
    return coded_size(grid, {}), MemorySource(from_grid(grid), origin=grid.origin)
