"""Experiments on pruning: larger and larger shares, and scores from few views or from one side only."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.goals.choice import Choice
from flexgs_edge.goals.target import MaxSize
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.effort import EFFORTS
from flexgs_edge.methods.best.grid_coder import SETTINGS_MOST
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.methods.paper.prune import order_from_scores
from flexgs_edge.methods.paper.scores import score_scene
from flexgs_edge.packed.bitspec import BitSpec
from flexgs_edge.quality.view_quality import ViewQuality
from flexgs_edge.report.plots import BarChart, LineChart
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.paper.quantization import FINE
from flexgs_edge.studies.result_tables import Cell, Row, Table, columns
from flexgs_edge.studies.speed.scoring import SCORES as SCORED
from flexgs_edge.studies.speed.scoring import score_rows
from flexgs_edge.studies.stability.amounts import Amounts
from flexgs_edge.studies.stability.baselines import add_plain_orders
from flexgs_edge.studies.stability.breaks import (
    BREAK,
    LOSSES,
    LOST,
    curve,
    mean_loss,
    number,
    of_choice,
    of_setting,
    of_source,
    where_it_breaks,
)
from flexgs_edge.studies.stability.ours import Whole, search, walked
from flexgs_edge.studies.study_scene import Setting, StudyScene

SCORES = ("random", "opacity", "volume", "gs", "meson", "dSE")
SH_ONLY, BEST = "SH only", "best's path"
HEADS = {"scores": "scored", "same": "loss on the same half (dB)", "other": "loss on the other half (dB)"}


def pruning(studied: StudyScene, path: PruneRounds, amounts: Amounts) -> Experiment:
    """Remove shares of the Gaussians, or their SH, by each score. Values have 16 bits, so only removal loses quality."""
    costs = path.snapshots[0]
    removal = np.full(studied.run.source.count, -np.inf)
    removal[path.rows[costs.rows]] = costs.costs.removal
    add_plain_orders(studied, removal)
    rows: list[dict[str, Cell]] = []
    for score in studied.run.progress.track(SCORES, "pruning", len(SCORES)):
        for share in amounts.pruned:
            found = of_setting(studied, Setting(Choice(share, 0), FINE, score=score))
            rows.append({"method": score, "share": share / 1000, **found.cells(studied)})
    for share in (*amounts.pruned, 1000):
        found = of_setting(studied, Setting(Choice(0, share), FINE))
        rows.append({"method": SH_ONLY, "share": share / 1000, **found.cells(studied)})
    rows += _path_rows(studied, path, max(amounts.pruned))
    names = (*SCORES, BEST)
    table = Table(columns(method="by", share="share", **LOSSES), tuple(rows))
    parts = {name: [row for row in rows if row["method"] == name] for name in (*names, SH_ONLY)}
    return Experiment(
        "pruning",
        "More and more removed",
        "Gaussians are removed in the order of a score. All values have 16 bits in sub-groups, so only removal loses "
        "quality. gs: the paper's score. meson: MesonGS's score. dSE: the measured squared error of removing each alone. "
        "SH only: every Gaussian stays, and a share loses its SH, by gs. best's path: removal in rounds, with costs "
        "measured again and colours refitted after each; its bytes count 16 bits a value for the share that stays.",
        table,
        LineChart(
            "Removing more and more: where each score breaks",
            "share of the Gaussians removed (SH only: share that lost its SH)",
            f"loss: {studied.plan.figure} (dB)",
            tuple(curve(part, name, "share") for name, part in parts.items()),
            limit=BREAK,
            magnitudes=True,
        ),
        tuple(
            where_it_breaks(part, name, lambda row: f"{100 * number(row, 'share'):.3g} %")
            for name, part in parts.items()
        ),
    )


def _path_rows(studied: StudyScene, path: PruneRounds, most: int) -> list[dict[str, Cell]]:
    """Rows for the snapshots of the rounds, until `most` thousandths are removed."""
    keep = EFFORTS[studied.run.options.effort].keep
    count = studied.run.source.count
    while path.snapshots[-1].count > (1 - most / 1000) * count and path.snapshots[-1].count > 16:
        path.descend(keep)
    rows: list[dict[str, Cell]] = []
    for snapshot in path.snapshots[1:]:
        share = 1 - snapshot.count / count
        size = studied.size(Setting(Choice(min(round(1000 * share), 999), 0), FINE))
        planes = snapshot.planes
        found = of_source(studied, lambda: (size, MemorySource(planes, origin=path.original.origin)))  # noqa: B023
        rows.append({"method": BEST, "share": round(share, 4), **found.cells(studied)})
    return rows


def views(studied: StudyScene, amounts: Amounts) -> Experiment:
    """Score from more and more views; compare ranks with those from all views, and losses of removing by them."""
    count = len(studied.views.train)
    choice = studied.search.chosen.choice
    rows = [
        {**row, "broke": LOST if number(row, studied.figure) > BREAK else None}
        for row in score_rows(studied, amounts.fewest, ("farthest", "first"))
    ]
    for row in rows:
        row.pop("seconds")
    heads = {
        "score": "score",
        "poses": "poses",
        "views": "views scored",
        "spearman": "rank correlation with all views",
        "unseen": "Gaussians without a score",
        "size": "bytes",
        "ratio": "ratio to PLY",
        "drop": "drop (dB)",
        "fidelity": "fidelity (dB)",
        "modelled_drop": "modelled drop (dB)",
        "broke": "broken by",
    }
    table = Table(columns(**heads), tuple(rows))
    series = {
        (score, poses): [row for row in rows if row["score"] == score and row["poses"] in (poses, "all")]
        for score in SCORED
        for poses in ("farthest", "first")
    }
    return Experiment(
        "views",
        "Too few views",
        f"Scores from some of the {count} training poses, each next one farthest from those before it, or the first "
        f"ones by name. Then the paper's method removes p = {choice.prune / 1000:g} and the SH of s = "
        f"{choice.sh / 1000:g}, so all files have one size. removal: measured costs. Gaussians that no scored pose sees "
        "have no score and are removed first.",
        table,
        LineChart(
            "Quality at one size, by the number of scored views",
            "views scored (log)",
            f"loss: {studied.plan.figure} (dB)",
            tuple(curve(part, f"{score}, {poses}", "views", studied.figure) for (score, poses), part in series.items()),
            limit=BREAK,
            log_x=True,
            magnitudes=True,
        ),
        tuple(_settled(part, f"{score}, {poses}", studied.figure) for (score, poses), part in series.items()),
    )


def _settled(rows: Sequence[Row], name: str, figure: str) -> str:
    """A sentence: from how many views on ranks and quality are about those of all views."""
    whole = number(rows[-1], figure)
    close = next(row for row in rows if number(row, figure) <= whole + 0.1)
    alike = next(row for row in rows if number(row, "spearman") >= 0.95)
    first = rows[0]
    return (
        f"{name}: {first['views']} views lose {number(first, figure):.2f} dB (rank correlation {first['spearman']}, "
        f"{first['unseen']} Gaussians unseen), all {rows[-1]['views']} lose {whole:.2f} dB; within 0.1 dB of that from "
        f"{close['views']} views on, ranks correlate by 0.95 from {alike['views']} on."
    )


def half_of(cameras: Sequence[Camera], axis: np.ndarray, middle: float) -> np.ndarray:
    """[n] bool: cameras beyond `middle` along `axis` ([3])."""
    return np.array([float(camera.center @ axis) > middle for camera in cameras])


def longest_axis(cameras: Sequence[Camera]) -> tuple[np.ndarray, float]:
    """The direction ([3]) along which the cameras spread most, and their median along it."""
    places = np.array([camera.center for camera in cameras])
    _, _, axes = np.linalg.svd(places - places.mean(axis=0), full_matrices=False)
    axis: np.ndarray = axes[0]
    return axis, float(np.median(places @ axis))


def halves(studied: StudyScene, ours: Whole) -> Experiment | None:
    """Score from one half of the training poses; judge on held-out views of this half and of the other."""
    cameras = studied.views.of(studied.views.train)
    axis, middle = longest_axis(cameras)
    near = half_of(cameras, axis, middle)
    judges = half_of(studied.judge.cameras, axis, middle)
    if not (judges.any() and (~judges).any() and near.any()):
        return None
    some = [camera for camera, side in zip(cameras, near) if side]
    rows: list[dict[str, Cell]] = []

    def add(method: str, scored: str, views: tuple[ViewQuality, ...]) -> None:
        same = mean_loss(studied, [view for view, side in zip(views, judges) if side])
        other = mean_loss(studied, [view for view, side in zip(views, judges) if not side])
        broke = LOST if max(same, other) > BREAK else None
        rows.append(
            {"method": method, "scores": scored, "same": round(same, 4), "other": round(other, 4), "broke": broke}
        )

    choice = studied.search.chosen.choice
    for score in SCORED:
        for scored, poses in (("all", cameras), ("one half", some)):
            evaluator = _ranked(studied, _score(studied, score, poses))
            found = of_choice(studied, lambda: evaluator, choice)  # noqa: B023
            assert found.quality is not None
            add(f"paper, {score}", scored, found.quality.views)
    with walked(studied, studied.run.source, some) as path:
        half = search(studied, path, MaxSize(ours.size + SETTINGS_MOST, studied.plan.figure))
    for scored, whole in (("all", ours), ("one half", half)):
        found = of_source(studied, lambda: (whole.size, whole.source))  # noqa: B023
        assert found.quality is not None
        add("best", scored, found.quality.views)
    table = Table(columns(method="method", **HEADS, broke="broken by"), tuple(rows))
    methods = list(dict.fromkeys(str(row["method"]) for row in rows))
    return Experiment(
        "halves",
        "Scored from one side",
        f"{len(some)} of the {len(cameras)} training poses, those on one side of the middle, are scored (best also "
        "refits colours to them), at one size for each method. Held-out views of that side and of the other "
        "judge.",
        table,
        BarChart(
            "Scored from one side, judged on both",
            f"loss: {studied.plan.figure} (dB)",
            methods,
            {
                "all poses, that side": table.values("same", scores="all"),
                "all poses, other side": table.values("other", scores="all"),
                "one side, that side": table.values("same", scores="one half"),
                "one side, other side": table.values("other", scores="one half"),
            },
            limit=BREAK,
        ),
        tuple(_one_side(rows, method) for method in methods),
    )


def _one_side(rows: Sequence[Row], method: str) -> str:
    whole, half = (row for row in rows if row["method"] == method)
    end = "breaks there" if half["broke"] else "stands"
    return (
        f"{method}: scored from one side it loses {number(half, 'other'):.2f} dB on the other and "
        f"{number(half, 'same'):.2f} dB on its own ({number(whole, 'other'):.2f} and {number(whole, 'same'):.2f} dB "
        f"from all poses): it {end}."
    )


def _score(studied: StudyScene, score: str, cameras: Sequence[Camera]) -> np.ndarray:
    renderer, source = studied.bench.renderer, studied.run.source
    with renderer.load(source) as scene:
        if score == "gs":
            values = score_scene(renderer, scene, source, cameras, "gs", studied.run.progress)
        else:
            values = measure_costs(studied.bench, scene, cameras, sh_costs=False, progress=studied.run.progress).removal
    renderer.release()
    return order_from_scores(values)


def _ranked(studied: StudyScene, order: np.ndarray) -> SceneEvaluator:
    bits, groups = studied.run.options.bit_spec()
    assert isinstance(bits, BitSpec)
    return SceneEvaluator(studied.ranked(order), bits, groups, studied.judge, studied.run.budget)
