"""Experiments on repeated compression: several generations at one size, and two targets in a row."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v2.container import coded_size, write_grid
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.target import MaxSize
from flexgs_edge.io.ply import write_ply
from flexgs_edge.methods.best.grid_coder import SETTINGS_MOST, GridCoder
from flexgs_edge.methods.best.keep import kept_as_it_is
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.paper.evaluator import Ranked, SceneEvaluator
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores
from flexgs_edge.methods.paper.scores import score_scene
from flexgs_edge.methods.paper.search import adapt
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.report.plots import LineChart
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.plan import EVERYTHING
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Row, Table, columns
from flexgs_edge.studies.stability.amounts import Amounts
from flexgs_edge.studies.stability.breaks import BREAK, LOSSES, Outcome, curve, number, of_choice, of_source
from flexgs_edge.studies.stability.ours import Whole, search, walked
from flexgs_edge.studies.study_scene import Setting, StudyScene

BEST, PAPER, RTN = "best", "paper", "RTN, 8 bits"
IN_A_ROW, DIRECT = "two targets", "one target"
FIRST_TIMES = 2.0
"""Size of the first of two targets in a row, as a multiple of the second."""
MOST_LOSS = 0.1
"""Most dB that all later generations together may lose beyond the first."""


class Copies:
    """Makes decompressed copies of a scene, as files in a folder.

    `folder`: for the files. There is one of each kind at a time.
    """

    def __init__(self, folder: Path) -> None:
        self.file, self.ply = folder / "copy.fgs", folder / "copy.ply"

    def of_grid(self, whole: Whole) -> SceneSource:
        """The PLY that a result of best decompresses to."""
        write_grid(self.file, whole.grid, {})
        return self._decompressed()

    def of_choice(self, evaluator: SceneEvaluator, choice: Choice) -> SceneSource:
        """The PLY that a file of the paper's method decompresses to."""
        with evaluator.quantized(choice) as quantized:
            write_container(self.file, quantized, {})
        return self._decompressed()

    def _decompressed(self) -> SceneSource:
        write_ply(self.ply, open_fgs(self.file), force=True)
        self.file.unlink()
        return load_scene(self.ply).source

    def remove(self) -> None:
        """Remove the last copy."""
        self.ply.unlink(missing_ok=True)


def generations(studied: StudyScene, path: PruneRounds, ours: Whole, amounts: Amounts, folder: Path) -> Experiment:
    """Compare all generations of three methods with the first original, and two targets in a row with one."""
    copies = Copies(folder)
    rows: list[dict[str, Cell]] = []

    def add(method: str, generation: int, count: int, found: Outcome) -> None:
        rows.append({"method": method, "generation": generation, "kept": count, **found.cells(studied)})

    whole = ours
    for generation in studied.run.progress.track(range(1, amounts.generations + 1), "generations", amounts.generations):
        if generation > 1:
            whole = _again(studied, copies.of_grid(whole), ours.size)
        add(BEST, generation, whole.grid.count, of_source(studied, lambda: (whole.size, whole.source)))  # noqa: B023
    for method, setting in (
        (PAPER, Setting(studied.search.chosen.choice)),
        (RTN, Setting(bits=BitSpec.rtn(8), groups=1)),
    ):
        evaluator, choice = studied.evaluator(setting), setting.choice
        for generation in range(1, amounts.generations + 1):
            if generation > 1:
                source = copies.of_choice(evaluator, choice)
                evaluator, choice = _evaluator(studied, source, np.arange(source.count), setting), EVERYTHING
            count = evaluator.counts(choice)[0]
            add(method, generation, count, of_choice(studied, lambda: evaluator, choice))  # noqa: B023
    first = search(studied, path, MaxSize(int(FIRST_TIMES * ours.size) + SETTINGS_MOST, studied.plan.figure))
    second = _again(studied, copies.of_grid(first), ours.size)
    add(f"{BEST}, {IN_A_ROW}", 2, second.grid.count, of_source(studied, lambda: (second.size, second.source)))
    add(f"{PAPER}, {IN_A_ROW}", 2, *_paper_in_a_row(studied, copies))
    copies.remove()
    table = Table(columns(method="method", generation="generation", kept="Gaussians kept", **LOSSES), tuple(rows))
    parts = {name: [row for row in rows if row["method"] == name] for name in (BEST, PAPER, RTN)}
    pairs = {name: [row for row in rows if row["method"] == f"{name}, {IN_A_ROW}"] for name in (BEST, PAPER)}
    return Experiment(
        "generations",
        "Generation after generation",
        "The scene is compressed, decompressed to a PLY and compressed again, each time to the bytes of the first file, and "
        f"judged against the first original. {RTN}: one range a channel. {IN_A_ROW}: first to {FIRST_TIMES:g} times the "
        "bytes, then from its PLY to the bytes of the first generation.",
        table,
        LineChart(
            "Loss of every generation",
            "generation",
            f"loss: {studied.plan.figure} (dB)",
            (
                *(curve(part, name, "generation") for name, part in parts.items()),
                *(curve(part, f"{name}, {IN_A_ROW}", "generation", line=False) for name, part in pairs.items()),
            ),
            limit=BREAK,
            magnitudes=True,
        ),
        (
            *(_beyond(part, name) for name, part in parts.items()),
            *(_in_a_row(pairs[name][0], parts[name][0], name) for name in pairs),
        ),
    )


def _again(studied: StudyScene, source: SceneSource, size: int) -> Whole:
    """Compress a scene to `size` bytes by best, as `compress` does."""
    target = MaxSize(size + SETTINGS_MOST, studied.plan.figure)
    run, coder = studied.run.of_source(source).aimed_at(target), GridCoder(studied.bench.renderer)
    # The limit leaves room for settings, because every search counts them.
    found = kept_as_it_is(run, studied.bench, coder, studied.judge, settings_known=False)
    if found is not None:
        grid, _ = found
        return Whole(grid, coded_size(grid, {}), 0.0, np.arange(grid.count), True)
    with walked(studied, source, studied.views.of(studied.views.train)) as path:
        return search(studied, path, target)


def _evaluator(studied: StudyScene, source: SceneSource, order: np.ndarray, setting: Setting) -> SceneEvaluator:
    return SceneEvaluator(
        Ranked(source, order, nonzero_sh(source)), setting.bits, setting.groups, studied.judge, studied.run.budget
    )


def _paper_in_a_row(studied: StudyScene, copies: Copies) -> tuple[int, Outcome]:
    last = Setting(studied.search.chosen.choice)
    size = studied.size(last)
    first = studied.adapt(MaxSize(int(FIRST_TIMES * size), studied.plan.figure)).chosen.choice
    source = copies.of_choice(studied.evaluator(Setting(first)), first)
    renderer = studied.bench.renderer
    with renderer.load(source) as scene:
        order = order_from_scores(score_scene(renderer, scene, source, studied.views.of(studied.views.train)))
    renderer.release()
    evaluator = _evaluator(studied, source, order, last)
    found = adapt(
        evaluator, MaxSize(size, studied.plan.figure), studied.run.options.effort, best_effort=True
    ).chosen.choice
    return evaluator.counts(found)[0], of_choice(studied, lambda: evaluator, found)


def _beyond(rows: list[dict[str, Cell]], name: str) -> str:
    first, last = rows[0], rows[-1]
    if last["loss"] is None or first["loss"] is None:
        return f"{name}: {last['broke'] or first['broke']}."
    beyond = number(last, "loss") - number(first, "loss")
    return (
        f"{name}: generation {last['generation']} loses {beyond:+.3f} dB against the first ({last['loss']} and "
        f"{first['loss']} dB, {last['size']} and {first['size']} bytes): "
        f"{'within' if beyond <= MOST_LOSS else 'NOT within'} {MOST_LOSS:g} dB."
    )


def _in_a_row(row: Row, direct: Row, name: str) -> str:
    return (
        f"{name}, {IN_A_ROW}: {row['loss']} dB in {row['size']} bytes; "
        f"{DIRECT}: {direct['loss']} dB in {direct['size']} bytes."
    )
