"""Experiments on the paper's whole method: its parts alone, rate-distortion, time and memory."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from benchmarks.paper.pruning import RATES
from benchmarks.paper.scene import Setting, StudyScene, beside
from flexgs_edge.goals.steps import MAX_PRUNE, Choice
from flexgs_edge.goals.target import Measurement, min_ratio
from flexgs_edge.memory.process import peak_rss
from flexgs_edge.methods.paper.prune import ranks_from_order, select_rows
from flexgs_edge.report.plots import BarChart, LineChart, Series
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.run.run import EVERYTHING
from flexgs_edge.scene.source import Planes, Rows, SceneSource, SelectSource
from flexgs_edge.studies.written import FIGURES, Cell, Experiment, Table

RATIOS = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256)
STRONGEST = Choice(MAX_PRUNE, 1000 - MAX_PRUNE)  # The strongest compression that the search may choose
PAPER_MEANS = ([100 / (100 - saved) for saved in (94.9, 96.1, 96.4)], [0.87, 0.86, 0.85])
"""The paper's mean ratios and drops on Mip-NeRF360, Tanks&Temples and Deep Blending."""
REPEATS = 5  # How often the parts of a step are timed. The median is shown.
PAPER_STEP = {"prune": 0.22, "quantize": 0.84, "dequantize": 0.32, "render and compare": 0.18}
"""Published seconds of the parts of a search step on an RTX 3090, rendering 32 views."""
PAPER_STEP_ALL = 1.56  # Published seconds of a whole step there


class Unquantized(SceneSource):
    """A scene after ADP, without quantization: rows with SH come first, then rows without."""

    def __init__(self, parent: SceneSource, with_sh: np.ndarray, without_sh: np.ndarray) -> None:
        self._rows = SelectSource(parent, np.concatenate([with_sh, without_sh]))
        self.name, self.origin, self.notes = parent.name, parent.origin, parent.notes
        self.count, self.sh_count = self._rows.count, len(with_sh) if parent.sh_degree else 0
        self.sh_degree = parent.sh_degree

    @property
    def value_bytes(self) -> int:
        """Bytes of a file of plain float32 arrays: 4 for every value that is left."""
        per_row = sum(self.width(name) for name in ("means", "sh_dc", "opacity_logits", "log_scales", "quats"))
        return 4 * (self.count * per_row + self.sh_count * self.width("sh_rest"))

    def read(self, rows: Rows, fields: Sequence[str], out: Planes | None = None) -> Planes:
        """See `SceneSource.read`."""
        rows, planes = self.begin_read(rows, fields, out)
        self._rows.read(rows, fields, planes)
        if "sh_rest" in planes:
            index = np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows
            planes["sh_rest"][:, index >= self.sh_count] = 0.0
        return planes


def parts(studied: StudyScene) -> Experiment:
    """Measure ADP only, MPQ only, and both, at the choice of the search."""
    choice = studied.search.chosen.choice
    pruned = _pruned(studied, choice)
    with studied.renderer.load(pruned) as scene:
        alone = measurement_of(studied.judge.compare(scene))
    quantized, both = studied.points([Setting(), Setting(choice)], "parts")
    none = Measurement(0.0 if studied.plan.figure == "drop" else None, None, 0.0)
    source = studied.run.source
    whole = (
        4
        * source.count
        * sum(source.width(name) for name in ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats"))
    )
    rows: list[dict[str, Cell]] = [
        {"method": "float32 values", **studied.figures(whole, none)},
        {"method": "ADP only", **studied.figures(pruned.value_bytes, alone)},
        {"method": "MPQ only", **studied.cells(quantized)},
        {"method": "ADP and MPQ", **studied.cells(both)},
    ]
    table = Table(dict(method="method", **FIGURES), tuple(rows))
    figure = studied.figure
    losses = [float(row[figure] or 0.0) for row in rows]
    words = [f"{row['method']}: {row['ratio']:.1f}x, {loss:.2f} dB" for row, loss in zip(rows, losses)]
    return Experiment(
        "parts",
        "Pruning only, quantization only, both",
        f"p = {choice.prune / 1000:g}, s = {choice.sh / 1000:g} (the search's choice) and the paper's bits. Without MPQ, "
        "sizes count 4 bytes for every float32 value that is left, no normals, no header. Ratios are to the PLY with normals.",
        table,
        LineChart(
            "What pruning, quantization and both cost",
            "ratio to the PLY",
            FIGURES[figure],
            (Series("", table.values("ratio"), table.values(figure), line=False, notes=words),),
            doublings=True,
        ),
        (
            f"ADP only: {rows[1]['ratio']}x at {losses[1]:.3f} dB; MPQ only: {rows[2]['ratio']}x at {losses[2]:.3f} dB; both: "
            f"{rows[3]['ratio']}x at {losses[3]:.3f} dB, where the two alone add up to {losses[1] + losses[2]:.3f} dB.",
        ),
    )


def _pruned(studied: StudyScene, choice: Choice) -> Unquantized:
    return Unquantized(studied.run.source, *select_rows(ranks_from_order(studied.orders["gs"]), choice, studied.has_sh))


def rates(studied: StudyScene) -> Experiment:
    """Find the best quality at sizes from 8 to 256 times below the PLY's, and the smallest size within reach."""
    rows: list[dict[str, Cell]] = [_rate_row(studied, "least", None, EVERYTHING)]
    ply = studied.run.scene.ply_bytes
    for ratio in studied.run.progress.track(RATIOS, "rates", len(RATIOS)):
        if studied.size(Setting(EVERYTHING)) <= ply / ratio:
            continue  # quantization alone makes the file smaller: see the row "least"
        found = studied.adapt(min_ratio(float(ratio), ply, studied.plan.figure))
        if found.reached:
            rows.append(_rate_row(studied, "search", ratio, found.chosen.choice))
    rows.append(_rate_row(studied, "most", None, STRONGEST))
    heads = dict(kind="kind", wanted_ratio="ratio wanted", **RATES, **FIGURES)
    table = Table(heads, tuple(rows))
    figure = studied.figure
    reached = table.values("wanted_ratio", kind="search")
    low, high = rows[0], rows[-1]
    missing = [ratio for ratio in RATIOS if ratio not in reached]
    ends = ["nothing pruned", *[""] * (len(rows) - 2), "end of the range"]
    return Experiment(
        "rates",
        "Rate and distortion from 8x to 256x",
        "For each ratio we search for the best quality in that size, at the paper's bits; the search chooses only the rates. "
        f"least: nothing pruned. most: the end of the search's range, p = {STRONGEST.prune / 1000:g} and no SH.",
        table,
        LineChart(
            "Rate and distortion",
            "ratio to the PLY",
            FIGURES[figure],
            (
                Series("here", table.values("ratio"), table.values(figure), notes=ends),
                Series("the paper's curve: its two ends", [8.0, 256.0], [0.05, 9.0], line=False),
                Series("the paper's means of three data sets", *PAPER_MEANS, line=False),
            ),
            limit=getattr(studied.target, "limit", None),
            doublings=True,
            magnitudes=True,
        ),
        (
            f"The method reaches from {low['ratio']}x ({low[figure]:.3f} dB, nothing pruned) to {high['ratio']}x "
            f"({high[figure]:.3f} dB); not reached: {', '.join(f'{ratio}x' for ratio in missing) or 'none of those asked for'}.",
            *(
                beside(
                    f"loss where {ratio}x is asked for",
                    f"{table.values(figure, wanted_ratio=ratio)[0]:.2f} dB at "
                    f"{table.values('ratio', wanted_ratio=ratio)[0]:.0f}x",
                    paper,
                )
                for ratio, paper in ((8, "0.05 dB"), (256, "9 dB"))
                if ratio in reached
            ),
        ),
    )


def _rate_row(studied: StudyScene, kind: str, ratio: int | None, choice: Choice) -> dict[str, Cell]:
    rates = {"prune_rate": choice.prune / 1000, "sh_rate": choice.sh / 1000}
    return {"kind": kind, "wanted_ratio": ratio, **rates, **studied.cells(studied.point(Setting(choice)))}


def times(studied: StudyScene) -> Experiment:
    """Time every stage and every part of a search step, and report the memory of the run."""
    steps = studied.search.steps
    stages = dict(studied.run.clock.stages)
    # Only this study scores by meson; the method does not.
    meson = stages.pop("score meson", 0.0)
    stages["search"] = sum(step.seconds for step in steps)
    whole = sum(stages.values())
    split = _step_parts(studied, studied.search.chosen.choice)
    step = sum(split.values())
    memory = peak_rss()
    rows = [_time(f"stage: {name}", seconds) for name, seconds in stages.items()]
    rows += [_time("all stages of compress", whole), _time("score meson, for comparison", meson)]
    rows += [_time(f"step: {name}", seconds, PAPER_STEP[name]) for name, seconds in split.items()]
    rows.append(_time("step: all", step, PAPER_STEP_ALL))
    rows += [_time(f"search step {number}", taken.seconds) for number, taken in enumerate(steps, 1)]
    rows.append({"part": "peak memory", "value": memory, "unit": "bytes", "paper": None})
    table = Table({"part": "part", "value": "here", "unit": "unit", "paper": "paper, RTX 3090"}, tuple(rows))
    source, views = studied.run.source, studied.views
    return Experiment(
        "times",
        "Time and memory",
        f"Wall seconds of this run: {source.count} Gaussians, {len(views.train)} training and "
        f"{len(studied.plan.decide)} deciding views. The parts of a step are medians of {REPEATS} at the search's answer; "
        "rendering includes comparing with the references. The paper's seconds are for its own, larger scenes and 32 views on "
        "an RTX 3090, so compare shares, not machines. Memory is the peak of the process, including "
        "earlier scenes.",
        table,
        BarChart(
            "A step of the search",
            "seconds",
            list(split),
            {
                "here": [round(seconds, 4) for seconds in split.values()],
                "paper (RTX 3090, larger scenes)": list(PAPER_STEP.values()),
            },
            digits=3,
        ),
        (
            f"All stages of a compress run {whole:.1f} s, of which the search {stages['search']:.1f} s in {len(steps)} steps; "
            f"peak memory of the process {memory / 2**30:.2f} GiB.",
            beside("whole run", f"{whole:.1f} s", "26 / 18 / 26 s on an RTX 3090, 59 to 135 s on a Jetson Xavier"),
            beside("one step of the search", f"{step:.2f} s", f"{PAPER_STEP_ALL} s"),
            beside(
                "peak memory",
                f"{memory / 2**30:.2f} GiB for {source.count / 1e6:.2f} M Gaussians",
                "6.75 GiB for 6.2 M, 21 GiB for 11.8 M",
            ),
        ),
        timed=True,
    )


def _time(part: str, seconds: float, paper: float | None = None) -> dict[str, Cell]:
    return {"part": part, "value": round(seconds, 4), "unit": "s", "paper": paper}


def _step_parts(studied: StudyScene, choice: Choice) -> dict[str, float]:
    """Median seconds of a step's parts, as `SceneEvaluator.measure` does them."""
    ranks = ranks_from_order(studied.orders["gs"])
    found: list[list[float]] = []
    evaluator, renderer, first = (studied.evaluator(Setting(choice)), studied.renderer, studied.judge.cameras[0])
    for _ in range(REPEATS):
        marks = [time.perf_counter()]
        select_rows(ranks, choice, studied.has_sh)
        marks.append(time.perf_counter())
        with evaluator.quantized(choice) as quantized:
            marks.append(time.perf_counter())
            with renderer.load_quantized(quantized) as scene:
                for _ in range(2):
                    renderer.render(scene, first)
                    marks.append(time.perf_counter())
                studied.judge.compare(scene)
                marks.append(time.perf_counter())
        prune, quantize, cold, warm, render = (b - a for a, b in zip(marks, marks[1:]))
        # Quantizing includes selecting rows, and the first view includes dequantizing, so both are subtracted.
        found.append([prune, max(quantize - prune, 0.0), max(cold - warm, 0.0), render])
    medians = np.median(np.array(found), axis=0)
    return {name: float(value) for name, value in zip(PAPER_STEP, medians)}
