"""Experiments on rounding: fewer bits, other groups, and other orders of the rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from flexgs_edge.codec.v2.container import coded_size
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.grid.values import from_grid
from flexgs_edge.io.exchange import near_order
from flexgs_edge.methods.paper.evaluator import Ranked, SceneEvaluator
from flexgs_edge.packed.bitspec import PAPER, BitSpec
from flexgs_edge.report.plots import LineChart
from flexgs_edge.scene.source import MemorySource, SceneSource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Row, Table, columns
from flexgs_edge.studies.stability.amounts import Amounts
from flexgs_edge.studies.stability.baselines import tensor_rounded
from flexgs_edge.studies.stability.breaks import (
    BREAK,
    LOSSES,
    Outcome,
    curve,
    of_choice,
    of_setting,
    of_source,
    where_it_breaks,
)
from flexgs_edge.studies.stability.ours import Whole
from flexgs_edge.studies.study_scene import Setting, StudyScene

TENSOR, CHANNEL, GROUPS, MPQ, BEST = "RTN, per tensor", "RTN, per channel", "RTN, sub-groups", "paper (MPQ)", "best"
ORDERS = ("file", "shuffled", "curve")


def rounding(studied: StudyScene, ours: Whole, amounts: Amounts) -> Experiment:
    """Compare plain rounding with 8 bits and fewer, in ranges of three kinds, and ever coarser grids of best."""
    rows: list[dict[str, Cell]] = []

    def add(method: str, bits: int | None, coarser: float | None, found: Outcome) -> None:
        rows.append({"method": method, "bits": bits, "coarser": coarser, **found.cells(studied)})

    source = studied.run.source
    for bits in studied.run.progress.track(amounts.bits, "bits", len(amounts.bits)):
        spec = BitSpec.rtn(bits)
        add(TENSOR, bits, None, of_source(studied, lambda: tensor_rounded(source, bits)))  # noqa: B023
        add(CHANNEL, bits, None, of_setting(studied, Setting(bits=spec, groups=1)))
        add(GROUPS, bits, None, of_setting(studied, Setting(bits=spec)))
    add(MPQ, None, None, of_setting(studied, Setting()))
    for factor in amounts.coarser:
        add(BEST, None, factor, of_source(studied, lambda: _coarser(ours, factor)))  # noqa: B023
    table = Table(columns(method="method", bits="bits a value", coarser="steps, times", **LOSSES), tuple(rows))
    parts = {method: [row for row in rows if row["method"] == method] for method in (TENSOR, CHANNEL, GROUPS)}
    own = [row for row in rows if row["method"] == BEST]
    return Experiment(
        "bits",
        "Fewer bits",
        f"RTN rounds every value to the same number of bits and removes nothing. It has one range for an attribute, for each "
        f"of its channels, or for each sub-group of about 512 rows. {MPQ}: 16, 8 and 4 bits in sub-groups. {BEST}: the result at "
        "the study's target, put on grids of larger and larger steps without another refit.",
        table,
        LineChart(
            "Fewer bits: where each way of rounding breaks",
            "ratio to the PLY",
            f"loss: {studied.plan.figure} (dB)",
            (
                *(curve(part, method, "ratio") for method, part in parts.items()),
                curve([row for row in rows if row["method"] == MPQ], MPQ, "ratio", line=False),
                curve(own, f"{BEST}, coarser grids", "ratio"),
            ),
            limit=BREAK,
            doublings=True,
            magnitudes=True,
        ),
        (
            *(where_it_breaks(part, method, lambda row: f"{row['bits']} bits") for method, part in parts.items()),
            where_it_breaks(own, BEST, lambda row: f"{row['coarser']:g} times its steps ({row['ratio']:.0f}x)"),
        ),
    )


def _scaled(steps: StepSizes, factor: float) -> StepSizes:
    kinds = ("position", "scale", "rotation", "opacity", "dc")
    larger = {kind: factor * getattr(steps, kind) for kind in kinds}
    return replace(steps, **larger, sh=tuple(factor * step for step in steps.sh))


def _coarser(ours: Whole, factor: float) -> tuple[int, MemorySource]:
    if factor == 1.0:
        return ours.size, ours.source
    planes = from_grid(ours.grid)
    grid, _ = to_grid(planes, ours.grid.sh_degrees, _scaled(ours.grid.step_sizes, factor), ours.grid.origin)
    return _of_grid(grid)


def _of_grid(grid: GridScene) -> tuple[int, MemorySource]:
    return coded_size(grid, {}), MemorySource(from_grid(grid), origin=grid.origin)


def groups(studied: StudyScene, ours: Whole, amounts: Amounts) -> Experiment:
    """Compare numbers of rows that share a range, from few to all, in three orders of the rows."""
    source = studied.run.source
    count = source.count
    orders = {
        "file": np.arange(count),
        "shuffled": np.random.default_rng(1).permutation(count),
        "curve": near_order(source),
    }
    rows: list[dict[str, Cell]] = []
    for name in studied.run.progress.track(ORDERS, "groups", len(ORDERS)):
        turned = source.select(orders[name]) if name != "file" else source
        evaluator = _evaluator(studied, turned, studied.has_sh[orders[name]])
        for ranges in dict.fromkeys(max(count // (share or count), 1) for share in amounts.group_rows):
            evaluator.groups, together = ranges, count // ranges
            rows.append(
                {"order": name, "together": together, **of_choice(studied, lambda: evaluator).cells(studied)}  # noqa: B023
            )
    shuffled = orders["shuffled"][: ours.grid.count]
    sizes = [ours.size, coded_size(_reordered(ours.grid, np.argsort(shuffled, kind="stable")), {})]
    table = Table(columns(order="order of rows", together="rows a group", **LOSSES), tuple(rows))
    parts = {name: [row for row in rows if row["order"] == name] for name in ORDERS}
    return Experiment(
        "groups",
        "Group sizes and the order of the rows",
        "The paper's bits, nothing removed, with a range (8 bytes a channel) for each group of consecutive rows. Rows are in the "
        "order of the file, shuffled, or along a space-filling curve. best puts rows in an order of its own.",
        table,
        LineChart(
            "Rows that share a range",
            "rows a group (log)",
            f"loss: {studied.plan.figure} (dB)",
            tuple(curve(part, f"{name} order", "together") for name, part in parts.items()),
            limit=BREAK,
            log_x=True,
            magnitudes=True,
        ),
        (
            *(
                f"{name} order: {min(_losses(part)):.3f} dB at best, {max(_losses(part)):.3f} dB at worst."
                for name, part in parts.items()
            ),
            f"best: {sizes[0]} bytes, and {sizes[1]} with its rows shuffled before.",
        ),
    )


def _losses(rows: Sequence[Row]) -> list[float]:
    return [float(row["loss"]) for row in rows if isinstance(row["loss"], float)] or [float("nan")]


def _reordered(grid: GridScene, order: np.ndarray) -> GridScene:
    """The grid of the same rows, made from another order."""
    planes = {name: values[:, order] for name, values in from_grid(grid).items()}
    return to_grid(planes, grid.sh_degrees[order], grid.step_sizes, grid.origin, rename=False)[0]


def _evaluator(studied: StudyScene, source: SceneSource, has_sh: np.ndarray, bits: BitSpec = PAPER) -> SceneEvaluator:
    order = np.arange(source.count)
    return SceneEvaluator(Ranked(source, order, has_sh), bits, None, studied.judge, studied.run.budget)
