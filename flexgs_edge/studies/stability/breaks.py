"""The loss of a compressed scene, and whether it counts as broken."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from flexgs_edge.goals.steps import Choice
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.quality.psnr import modelled_drop
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.report.plots import Series
from flexgs_edge.studies.result_tables import Row
from flexgs_edge.studies.study_scene import StudyScene

BREAK = 3.0  # A method has broken if it loses more than this, in dB: twice the squared error
LOST = f"lost {BREAK:g} dB"


def view_loss(studied: StudyScene, view: ViewQuality) -> float:
    """Loss of one view in dB, in the figure that decides: its drop against the photo, or its modelled drop."""
    if studied.plan.figure == "drop" and view.loss is not None:
        return view.loss
    error = view.covered_error or 0.0 if studied.judge.covered_decides else view.error
    return modelled_drop(error, studied.run.options.base_psnr)


def mean_loss(studied: StudyScene, views: Sequence[ViewQuality]) -> float:
    """Mean loss of some views in the figure that decides, dB."""
    if studied.plan.figure == "drop":
        return math.fsum(view_loss(studied, view) for view in views) / len(views)
    base_psnr = studied.run.options.base_psnr
    return modelled_drop(Quality(tuple(views), covered_decides=studied.judge.covered_decides).deciding_error, base_psnr)


@contextmanager
def drawn(studied: StudyScene, evaluator: SceneEvaluator, choice: Choice) -> Iterator[DeviceScene]:
    """The scene of a choice, quantized and loaded."""
    with evaluator.quantized(choice) as quantized, studied.bench.renderer.load_quantized(quantized) as scene:
        yield scene


def number(row: Row, column: str) -> float:
    """The number in a cell."""
    value = row[column]
    assert isinstance(value, (int, float)), f"{column}: {value!r}"
    return float(value)


def curve(rows: Sequence[Row], label: str, x: str, y: str = "loss", line: bool = True, every: bool = False) -> Series:
    """Rows as a series of a chart. Its first break is marked, or with `every` all breaks. Points with an error have no y."""
    shown = [row for row in rows if row[x] is not None]
    broken = [number(row, x) for row in shown if row["broke"] is not None]
    return Series(
        label,
        [number(row, x) for row in shown],
        [None if row[y] is None else number(row, y) for row in shown],
        line=line,
        broken=broken if every else broken[:1],
    )
