"""`study speed`: how much time each method and effort of `compress` takes, and the ratio that it finds."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.commands.compress import compress
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.quality_evaluator import measurement_of
from flexgs_edge.studies import written

PRESETS = (("paper", "balanced"), ("best", "fast"), ("best", "balanced"))  # Method and effort of each run
HEADS = {
    "method": "method",
    "effort": "effort",
    "seconds": "seconds",
    "search_seconds": "of them, search",
    "steps": "results measured",
    **written.FIGURES,
    "kept": "Gaussians kept",
    "reached": "target met",
    "front": "on the front",
}


def study_speed(
    scene: str | Path,
    output: str | Path,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    **words: Any,
) -> written.Study:
    """Measure the time and the ratio of every preset on a scene and write them to a folder."""
    options = replace(options or CompressOptions(), **words)
    return written.write_study(
        "study speed",
        output,
        options.force,
        "Speed and accuracy",
        _INTRO,
        lambda folder: _study(scene, options, progress),
    )


_INTRO = (
    "What searching less costs. The Pareto front joins points that no other point beats in time and ratio. Times are wall "
    "times of this run on the device named below. Everything but times, and the front that they decide, is equal in every run."
)


def _study(path: str | Path, options: CompressOptions, progress: Progress) -> written.SceneStudy:
    """One dry run of `compress` for each preset, all with the same target."""
    rows: list[dict[str, written.Cell]] = []
    for method, effort in PRESETS:
        LOG.info("compress --method %s --effort %s", method, effort)
        words = replace(options, method=method, effort=effort, dry_run=True, best_effort=True, report=None)
        found = compress(path, None, words, progress)
        rows.append(_row(method, effort, found))
    best = front([written.number(row, "seconds") for row in rows], [written.number(row, "ratio") for row in rows])
    for row, on in zip(rows, best):
        row["front"] = on
    table = written.Table(HEADS, tuple(rows))
    experiment = written.Experiment(
        "presets",
        "Time of a whole run and the ratio that it finds",
        f"compress by each method and effort, asked for {found.target}: opening, scoring, searching, coding and measuring the "
        "final quality. All run in one process, whose device is started and whose kernels are built before. Nothing is written.",
        table,
        LineChart(
            "Time of a run against the ratio that it finds",
            "seconds of the run (log)",
            "ratio to the PLY",
            tuple(
                Series(
                    method,
                    table.values("seconds", method=method),
                    table.values("ratio", method=method),
                    notes=table.values("effort", method=method),
                )
                for method in dict.fromkeys(str(row["method"]) for row in rows)
            ),
            log_x=True,
            front=[(written.number(row, "seconds"), written.number(row, "ratio")) for row in rows if row["front"]],
        ),
        (
            "; ".join(
                f"{row['method']} {row['effort']}: {row['ratio']:.1f}x at {_loss(row)} in {row['seconds']:.1f} s"
                for row in rows
            )
            + ".",
        ),
        timed=True,
    )
    return written.SceneStudy.of(path, found, experiment)


def _row(method: str, effort: str, found: CompressResult) -> dict[str, written.Cell]:
    assert found.quality is not None
    return {
        "method": method,
        "effort": effort,
        "seconds": round(found.run.seconds - found.run.startup_seconds, 2),
        "search_seconds": round(found.run.stages.get("search", 0.0), 2),
        "steps": 0 if found.search is None else len(found.search.steps),
        **written.figures(found.size, found.scene.ply_bytes, measurement_of(found.quality)),
        "kept": found.count,
        "reached": found.reached,
    }


def _loss(row: dict[str, written.Cell]) -> str:
    name = "modelled_drop" if row["drop"] is None else "drop"
    return f"{float(row[name] or 0.0):.3f} dB"


def front(costs: Sequence[float], worths: Sequence[float]) -> list[bool]:
    """For each point, whether it is on the front: no other, different point costs at most as much and is worth at least as much.

    >>> front([1.0, 2.0, 3.0, 3.0], [5.0, 4.0, 6.0, 6.0])
    [True, False, True, True]
    """
    points = list(zip(costs, worths))
    return [not any(c <= cost and w >= worth and (c, w) != (cost, worth) for c, w in points) for cost, worth in points]
