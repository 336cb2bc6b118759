"""Measures how many views a score needs: time of scoring, and quality at one size."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.order import covering_order, farthest_order
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.methods.paper.evaluator import SceneEvaluator
from flexgs_edge.methods.paper.prune import order_from_scores
from flexgs_edge.methods.paper.scores import score_scene
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.scene.sample import some_positions
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Table, columns
from flexgs_edge.studies.speed.front import front
from flexgs_edge.studies.study_scene import FIGURES, RANK_BYTES, StudyScene

FEWEST = 4
SCORES = {"gs": "the paper's score gs", "removal": "measured costs of removal"}
ORDERS = {
    "covering": "each next pose adds most to what those before it see, as in compress",
    "farthest": "each next pose is farthest from those before it",
    "even": "poses spread evenly by name",
    "first": "the first poses by name",
}
COMPARED = ("covering", "farthest", "even")
"""The orders among `ORDERS` that `study speed` compares."""
ALL = "all"
HEADS = {"score": "score", "poses": "poses", "views": "views scored"}


def view_counts(count: int, fewest: int = FEWEST) -> list[int]:
    """Numbers of views: `fewest`, then always twice as many below `count`, and `count` itself.

    >>> view_counts(20), view_counts(3), view_counts(3, 1)
    ([4, 8, 16, 20], [3], [1, 2, 3])
    """
    counts, views = [], fewest
    while views < count:
        counts.append(views)
        views *= 2
    return [*counts, count]


def spearman(a: np.ndarray, b: np.ndarray) -> float:
    """Rank correlation of two [N] scores. Equal values share the mean of their ranks, and infinities are allowed.

    >>> spearman(np.array([1.0, 2.0, 3.0]), np.array([-np.inf, 5.0, 9.0])), spearman(np.arange(3), -np.arange(3))
    (1.0, -1.0)
    """
    x, y = _ranks(a), _ranks(b)
    x -= x.mean()
    y -= y.mean()
    norm = float(np.sqrt(np.square(x).sum() * np.square(y).sum()))
    return round(float((x * y).sum()) / norm, 12) if norm else 1.0


def _ranks(values: np.ndarray) -> np.ndarray:
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts + 1) / 2)[place]


def scoring(studied: StudyScene) -> list[Experiment]:
    """Score from more and more views; compare times, ranks and quality."""
    rows = score_rows(studied)
    best = front([float(row["seconds"] or 0) for row in rows], [-float(row[studied.figure] or 0) for row in rows])
    for row, on in zip(rows, best):
        row["front"] = on
    count = len(studied.views.train)
    return [_quality(studied, rows, count), _stability(rows, count)]


def score_rows(studied: StudyScene, fewest: int = FEWEST, orders: Sequence[str] = COMPARED) -> list[dict[str, Cell]]:
    """Rows for each score from more and more views: seconds, ranks, and quality of the search's choice.

    `studied`: the scene. `fewest`: views in the smallest set. `orders`: names in `ORDERS`, which decide the views of a
    set.
    """
    cameras = studied.views.of(studied.views.train)
    counts = view_counts(len(cameras), fewest)
    positions = some_positions(studied.run.source)
    covering = covering_order(cameras, positions, studied.bench.renderer.near, len(cameras))
    spread = farthest_order(cameras)
    places: dict[str, Callable[[int], list[int]]] = {
        "covering": lambda count: sorted(covering[:count]),
        "farthest": lambda count: sorted(spread[:count]),
        "even": lambda count: [i * len(cameras) // count for i in range(count)],
        "first": lambda count: list(range(count)),
    }
    sets: list[tuple[str, int, list[Camera]]] = [(ALL, len(cameras), cameras)]
    sets += [(name, n, [cameras[i] for i in places[name](n)]) for n in counts[:-1] for name in orders]
    choice = studied.search.chosen.choice  # before the scene is loaded below, because the search draws other scenes
    rows: list[dict[str, Cell]] = []
    budget = studied.run.budget
    size = (8 * len(sets) + RANK_BYTES) * studied.run.source.count
    budget.take("scores of several sets of poses", size)
    try:
        for score in SCORES:
            found = _scores(studied, score, sets)
            for (poses, count, _), (values, seconds) in zip(sets, found):
                evaluator = _evaluator(studied, order_from_scores(values))
                rows.append(
                    {
                        "score": score,
                        "poses": poses,
                        "views": count,
                        "seconds": round(seconds, 4),
                        "spearman": round(spearman(values, found[0][0]), 4),
                        "unseen": int(np.count_nonzero(values == (-np.inf if score == "gs" else 0.0))),
                        **studied.figures(evaluator.size(choice), evaluator.measure(choice)),
                    }
                )
    finally:
        budget.give(size)
    rows.sort(key=lambda row: (list(SCORES).index(str(row["score"])), str(row["poses"]) == ALL, int(row["views"] or 0)))
    return rows


def _scores(
    studied: StudyScene, score: str, sets: Sequence[tuple[str, int, list[Camera]]]
) -> list[tuple[np.ndarray, float]]:
    """Scores ([N] f64) and seconds of each set of poses."""
    source, renderer = studied.run.source, studied.bench.renderer
    storage = sum_bytes(2) + cost_bytes(source.sh_degree)
    found = []
    with renderer.load(source, storage) as scene:
        make: dict[str, Callable[[list[Camera]], np.ndarray]] = {
            "gs": lambda poses: score_scene(renderer, scene, source, poses, "gs", studied.run.progress),
            # Costs of SH come from the same pass, so they are measured too, as the method `best` does.
            "removal": lambda poses: measure_costs(studied.bench, scene, poses, progress=studied.run.progress).removal,
        }
        make[score](sets[0][2][:1])
        for _, _, poses in sets:
            started = time.perf_counter()
            values = make[score](poses)
            found.append((values, time.perf_counter() - started))
    renderer.release()
    return found


def _evaluator(studied: StudyScene, order: np.ndarray) -> SceneEvaluator:
    """An evaluator like `studied.evaluator`, with rows in another order."""
    bits, groups = studied.run.options.bit_spec()
    assert bits is not None
    return SceneEvaluator(studied.ranked(order), bits, groups, studied.judge, studied.run.budget)


def _quality(studied: StudyScene, rows: list[dict[str, Cell]], count: int) -> Experiment:
    figure, choice = studied.figure, studied.search.chosen.choice
    table = Table(
        columns(
            **HEADS,
            seconds="seconds",
            spearman="rank correlation with all views",
            unseen="Gaussians without a score",
            **FIGURES,
            front="on the front",
        ),
        tuple(rows),
    )
    whole = {row["score"]: row for row in rows if row["poses"] == ALL}
    return Experiment(
        "scoring",
        "Quality by the number of scored views",
        f"The Gaussians are ranked from some of the {count} training poses; then the paper's method removes p = "
        f"{choice.prune / 1000:g} of them and the SH of s = {choice.sh / 1000:g} at its own bits, so all files have one "
        f"size. gs: {SCORES['gs']}; removal: {SCORES['removal']}, from the pass that also measures costs of SH. covering: "
        f"{ORDERS['covering']}; farthest: {ORDERS['farthest']}; even: {ORDERS['even']}. Gaussians that no scored pose sees "
        "have no score and are removed first. Seconds are of scoring alone.",
        table,
        LineChart(
            "Time of scoring against quality at one size",
            "seconds of scoring (log)",
            FIGURES[figure],
            tuple(_series(rows, score, poses, "seconds", figure) for score in SCORES for poses in COMPARED),
            log_x=True,
            magnitudes=True,
            front=[(float(row["seconds"] or 0), float(row[figure] or 0)) for row in rows if row["front"]],
        ),
        tuple(_words(rows, whole[score], score, figure) for score in SCORES),
        timed=True,
    )


def _words(rows: Sequence[dict[str, Cell]], whole: dict[str, Cell], score: str, figure: str) -> str:
    few = [row for row in rows if row["score"] == score and row["poses"] == COMPARED[0]]
    words = [
        f"{row['views']} views {float(row[figure] or 0):.3f} dB in {float(row['seconds'] or 0):.2f} s"
        for row in [*few, whole]
    ]
    return f"{score}, {FIGURES[figure].removesuffix(' (dB)')} by {COMPARED[0]} poses: {'; '.join(words)}."


def _stability(rows: list[dict[str, Cell]], count: int) -> Experiment:
    names = ("score", "poses", "views", "spearman")
    table = Table(
        columns(**HEADS, spearman="rank correlation with all views"),
        tuple({name: row[name] for name in names} for row in rows),
    )
    findings = []
    for score in SCORES:
        parts = [
            f"{poses} {row['views']} views {row['spearman']:.3f}"
            for poses in COMPARED
            for row in rows
            if (row["score"], row["poses"]) == (score, poses)
        ]
        if parts:
            findings.append(f"{score}: {'; '.join(parts)}.")
    return Experiment(
        "stability",
        "Ranks from a few views against those from all",
        f"Spearman's correlation of each score with the same score from all {count} training poses, over all Gaussians.",
        table,
        LineChart(
            "Ranks from a few views against those from all",
            "views scored (log)",
            "rank correlation with all views",
            tuple(_series(rows, score, poses, "views", "spearman") for score in SCORES for poses in COMPARED),
            log_x=True,
            floating=True,
        ),
        tuple(findings) or ("There are too few views to take some of them.",),
    )


def _series(rows: Sequence[dict[str, Cell]], score: str, poses: str, x: str, y: str) -> Series:
    shown = [row for row in rows if row["score"] == score and row["poses"] in (poses, ALL)]
    # All orders have the same numbers of views, so only one series names them.
    notes = [str(row["views"]) if x != "views" and poses == COMPARED[0] else "" for row in shown]
    return Series(
        f"{score}, {poses}", [float(row[x] or 0) for row in shown], [float(row[y] or 0) for row in shown], notes=notes
    )
