"""Experiments on single held-out views: the worst one, and the gap between views that decide and views that do not."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from flexgs_edge.goals.promise import WORST_MORE, WORST_TIMES, Promised, WorstView
from flexgs_edge.goals.target import MaxDrop
from flexgs_edge.methods.best.rounds import PruneRounds
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.quality.view_quality import Quality, ViewQuality
from flexgs_edge.report.plots import BarChart
from flexgs_edge.run.few_poses import evenly
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.studies.result_tables import Cell, Experiment, Row, Table, columns
from flexgs_edge.studies.stability.ours import (
    BEST,
    BREAK,
    LOST,
    MARGIN,
    WORDS,
    Contenders,
    Whole,
    mean_loss,
    number,
    search,
    view_loss,
)
from flexgs_edge.studies.stability.unseen_poses import TILE_SIDE, Amounts, worst_tile
from flexgs_edge.studies.study_scene import StudyScene

EVEN, HELD = "best, decided on even views", "best, --max-worst-drop"
HEADS = {
    "method": "method",
    "size": "bytes",
    "loss": "loss, mean (dB)",
    "worst": "loss of the worst view (dB)",
    "allowed": "allowed for the worst (dB)",
    "within": "within",
    "view": "worst view",
    "even": "loss of even views (dB)",
    "odd": "loss of odd views (dB)",
    "fidelity": "fidelity (dB)",
    "training": "fidelity at training poses (dB)",
    "tile": f"worst tile of {TILE_SIDE}x{TILE_SIDE} (dB)",
    "tile_view": "view of that tile",
    "broke": "broken by",
}


def held_out(studied: StudyScene, path: PruneRounds, contenders: Contenders, amounts: Amounts) -> Experiment:
    """Compare all contenders view by view; also best with only even views deciding, and best with a bound on the worst view."""
    cameras = studied.judge.cameras
    whole: dict[str, Whole] = {}
    if amounts.even and len(cameras) > 1:
        whole[EVEN] = _decided_on_even(studied, path)
        if isinstance(studied.target, MaxDrop):
            limit = WORST_TIMES * studied.target.limit
            whole[HELD] = search(studied, path, Promised(studied.target, (WorstView(studied.target.figure, limit),)))
    rows = []
    train = evenly(studied.views.of(studied.views.train), len(cameras))
    renderer = studied.context.renderer
    with renderer.load(studied.run.source) as scene:
        originals = [renderer.render(scene, camera) for camera in train]
    for name in (*contenders.names, *whole):
        loaded = renderer.load(whole[name].source) if name in whole else contenders.loaded(name)
        with loaded as scene:
            quality = studied.judge.compare(scene)
            tiles = [worst_tile(renderer.render(scene, c), studied.judge.original(i)) for i, c in enumerate(cameras)]
            errors = [mse(renderer.render(scene, c), original) for c, original in zip(train, originals)]
        size = whole[name].size if name in whole else contenders.size(name)
        rows.append(_row(studied, name, size, quality, tiles, errors))
    renderer.release()
    table = Table(columns(**HEADS), tuple(rows))
    views = "photos" if studied.plan.figure == "drop" else "renders of the original"
    return Experiment(
        "heldout",
        "The worst view, and views that decided nothing",
        f"The {len(cameras)} held-out views one by one, against {views}. A worst view within {WORST_TIMES:g} times "
        f"the mean plus {WORST_MORE:g} dB counts as within. {EVEN}: only the first, third, ... view decides. "
        f"{HELD}: no view loses more than {WORST_TIMES:g} times the target. " + WORDS,
        table,
        BarChart(
            "Mean and worst held-out view",
            f"loss: {studied.plan.figure} (dB)",
            [str(row["method"]).replace(", ", ",\n") for row in rows],
            {
                "mean": table.values("loss"),
                "worst view": table.values("worst"),
                "even views": table.values("even"),
                "odd views": table.values("odd"),
            },
            limit=BREAK,
        ),
        (
            *(_words(row) for row in rows if row["method"] in (BEST, MARGIN, EVEN, HELD)),
            *(_baseline(row) for row in rows if row["method"] in contenders.settings),
        ),
    )


def _decided_on_even(studied: StudyScene, path: PruneRounds) -> Whole:
    source = studied.run.source
    judge = QualityEvaluator(
        studied.context,
        source,
        studied.views,
        studied.judge.indices[::2],
        studied.plan.figure == "drop",
        studied.run.options.base_psnr,
    )
    try:
        with studied.context.renderer.load(source) as original:
            judge.prepare(original, studied.run.progress)
        return search(studied, path, studied.target, judge)
    finally:
        judge.close()


def _row(
    studied: StudyScene, name: str, size: int, quality: Quality, tiles: Sequence[float], errors: Sequence[float]
) -> dict[str, Cell]:
    views = quality.views
    losses = [view_loss(studied, view) for view in views]
    loss, worst = mean_loss(studied, views), max(losses)
    allowed = WORST_TIMES * max(loss, 0.0) + WORST_MORE
    at = int(np.argmax(tiles))
    return {
        "method": name,
        "size": size,
        "loss": round(loss, 4),
        "worst": round(worst, 4),
        "allowed": round(allowed, 4),
        "within": worst <= allowed,
        "view": views[losses.index(worst)].name,
        "even": _some(studied, views[::2]),
        "odd": _some(studied, views[1::2]),
        "fidelity": _decibel(quality.fidelity),
        "training": _decibel(mean_psnr([psnr(error) for error in errors])),
        "tile": _decibel(psnr(tiles[at])),
        "tile_view": views[at].name,
        "broke": LOST if worst > BREAK else None,
    }


def _some(studied: StudyScene, views: Sequence[ViewQuality]) -> float | None:
    return round(mean_loss(studied, views), 4) if views else None


def _decibel(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _words(row: Row) -> str:
    gap = ""
    if row["odd"] is not None:
        apart = number(row, "odd") - number(row, "even")
        gap = f" Odd views lose {apart:+.3f} dB against even ones ({row['odd']} and {row['even']} dB)."
    return (
        f"{row['method']}: mean {row['loss']} dB, worst view {row['view']} {row['worst']} dB, allowed "
        f"{row['allowed']} dB: {'within' if row['within'] else 'NOT within'}; worst tile {row['tile']} dB "
        f"({row['tile_view']}); fidelity {row['fidelity']} dB, at training poses {row['training']} dB.{gap}"
    )


def _baseline(row: Row) -> str:
    end = "broken" if row["broke"] else "stands"
    return f"{row['method']}: mean {row['loss']} dB, worst view {row['worst']} dB, worst tile {row['tile']} dB: {end}."
