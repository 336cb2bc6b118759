"""The loss of a compressed scene, and whether it counts as broken."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass

from flexgs_edge.errors import FlexGSError
from flexgs_edge.goals.choice import Choice
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.quality.psnr import modelled_drop
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.report.plots import Series
from flexgs_edge.run.plan import EVERYTHING
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.studies.result_tables import Cell, Row
from flexgs_edge.studies.study_scene import Setting, StudyScene

BREAK = 3.0
"""A method has broken if it loses more than this, in dB: twice the squared error."""
LOST = f"lost {BREAK:g} dB"

LOSSES = {
    "size": "bytes",
    "ratio": "ratio to PLY",
    "loss": "loss (dB)",
    "worst": "loss of the worst view (dB)",
    "fidelity": "fidelity (dB)",
    "broke": "broken by",
}
"""Columns at the end of rows of outcomes, and their heads."""


@dataclass(frozen=True)
class Outcome:
    """Size and quality of a compressed scene, or the error that compressing or drawing raised."""

    size: int | None
    quality: Quality | None
    error: str | None = None

    def cells(self, studied: StudyScene) -> dict[str, Cell]:
        """Cells of the columns `LOSSES`."""
        quality = self.quality
        if quality is None or self.size is None:
            return {**dict.fromkeys(LOSSES), "broke": f"error: {self.error}"}
        loss = mean_loss(studied, quality.views)
        fidelity = quality.fidelity
        return {
            "size": self.size,
            "ratio": round(studied.run.scene.ply_bytes / self.size, 3),
            "loss": round(loss, 4),
            "worst": round(max(view_loss(studied, view) for view in quality.views), 4),
            "fidelity": None if fidelity is None else round(fidelity, 4),
            "broke": LOST if loss > BREAK else None,
        }


def view_loss(studied: StudyScene, view: ViewQuality) -> float:
    """Loss of one view in dB, in the figure that decides: its drop against the photo, or its modelled drop."""
    if studied.plan.figure == "drop" and view.loss is not None:
        return view.loss
    error = view.covered_error or 0.0 if studied.judge.covered_decides else view.error
    return modelled_drop(error, studied.judge.base_psnr)


def mean_loss(studied: StudyScene, views: Sequence[ViewQuality]) -> float:
    """Mean loss of some views in the figure that decides, dB."""
    if studied.plan.figure == "drop":
        return math.fsum(view_loss(studied, view) for view in views) / len(views)
    base_psnr = studied.judge.base_psnr
    return modelled_drop(Quality(tuple(views), covered_decides=studied.judge.covered_decides).deciding_error, base_psnr)


def outcome(studied: StudyScene, make: Callable[[], tuple[int, AbstractContextManager[DeviceScene]]]) -> Outcome:
    """Measure the scene that `make` returns (bytes, and the scene to draw), or keep its error."""
    try:
        size, loaded = make()
        with loaded as scene:
            return Outcome(size, studied.judge.compare(scene))
    except FlexGSError as error:
        return Outcome(None, None, str(error))


def of_source(studied: StudyScene, make: Callable[[], tuple[int, SceneSource]]) -> Outcome:
    """As `outcome`, for a source."""

    def load() -> tuple[int, AbstractContextManager[DeviceScene]]:
        size, source = make()
        return size, studied.bench.renderer.load(source)

    return outcome(studied, load)


def of_setting(studied: StudyScene, setting: Setting) -> Outcome:
    """As `outcome`, for a setting."""
    return of_choice(studied, lambda: studied.evaluator(setting), setting.choice)


def of_choice(studied: StudyScene, make: Callable[[], SceneEvaluator], choice: Choice = EVERYTHING) -> Outcome:
    """As `outcome`, for a choice of an evaluator."""

    def load() -> tuple[int, AbstractContextManager[DeviceScene]]:
        evaluator = make()
        return evaluator.size(choice), drawn(studied, evaluator, choice)

    return outcome(studied, load)


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


def where_it_breaks(rows: Sequence[Row], name: str, words: Callable[[Row], str], y: str = "loss") -> str:
    """A sentence: up to which row `name` stands, and where it breaks first. Rows go from mild to harsh."""
    first = next((place for place, row in enumerate(rows) if row["broke"] is not None), None)
    if first is None:
        worst = max(rows, key=lambda row: number(row, y))
        return f"{name} stands everywhere (at worst {number(worst, y):.2f} dB, {words(worst)})."
    row = rows[first]
    lost = str(row["broke"]) if row[y] is None else f"{number(row, y):.2f} dB"
    before = f"stands up to {words(rows[first - 1])} ({number(rows[first - 1], y):.2f} dB) and " if first else ""
    return f"{name} {before}breaks at {words(row)} ({lost})."
