"""Measures how times grow: of a view with Gaussians and pixels, of scoring with views."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.methods.paper.scores import gather_statistics
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Table, columns
from flexgs_edge.studies.speed.scoring import view_counts
from flexgs_edge.studies.speed.timing import STAGES, draw_seconds, slope, stage_seconds
from flexgs_edge.studies.study_scene import StudyScene

REPEATS = 5
PARTS = (0.125, 0.25, 0.5, 1.0)
"""Shares of the Gaussians, drawn at random."""
SIDES = (0.25, 0.5, 1.0, 2.0)
"""Factors on both sides of a picture."""
SEED = 0


@dataclass(frozen=True)
class Load:
    """A scene and views to draw, with the amount of whatever grows."""

    kind: str
    amount: int
    source: SceneSource
    cameras: Sequence[Camera]


def scaling(studied: StudyScene, repeats: int = REPEATS) -> Experiment:
    """Time loads that grow in one respect at a time."""
    source, cameras = studied.run.source, studied.judge.cameras
    loads = [Load("Gaussians", len(rows), source.select(rows), cameras) for rows in _subsets(source.count)]
    for side in SIDES:
        views = [c.scaled(max(round(side * c.width), 1), max(round(side * c.height), 1)) for c in cameras]
        pixels = sum(view.width * view.height for view in views) // len(views)
        loads.append(Load("pixels", pixels, source, views))
    times: list[list[float]] = [[] for _ in loads]
    stages: list[list[dict[str, float]]] = [[] for _ in loads]
    renderer = studied.bench.renderer
    for _ in studied.run.progress.track(range(repeats), "scaling", repeats):
        for place, load in enumerate(loads):
            with renderer.load(load.source) as scene:
                times[place].append(draw_seconds(renderer, scene, load.cameras) / len(load.cameras))
                stages[place].append(stage_seconds(renderer, scene, load.cameras))
    renderer.release()
    rows = [_row(load, passes, parts) for load, passes, parts in zip(loads, times, stages)]
    rows += _by_views(studied, repeats)
    return _experiment(studied, rows, repeats)


def _subsets(count: int) -> list[np.ndarray]:
    """Random rows, ascending; each set contains the one before it."""
    order = np.random.default_rng(SEED).permutation(count)
    return [np.sort(order[: max(round(part * count), 1)]) for part in PARTS]


def _row(load: Load, times: list[float], stages: list[dict[str, float]]) -> dict[str, Cell]:
    views = len(load.cameras)
    by_stage = {name: round(1e3 * min(found[name] for found in stages) / views, 4) for name in STAGES}
    return {"kind": load.kind, "amount": load.amount, "ms": round(1e3 * min(times), 3), **_columns(by_stage)}


def _columns(by_stage: dict[str, float]) -> dict[str, Cell]:
    return {name.replace(" ", "_"): by_stage.get(name) for name in STAGES}


def _by_views(studied: StudyScene, repeats: int) -> list[dict[str, Cell]]:
    """Time scoring (hits and weights) over more and more training poses."""
    renderer, cameras = studied.bench.renderer, studied.views.of(studied.views.train)
    counts = view_counts(len(cameras))
    spread = {count: [cameras[i * len(cameras) // count] for i in range(count)] for count in counts}
    times: dict[int, list[float]] = {count: [] for count in counts}
    with renderer.load(studied.run.source) as scene:
        gather_statistics(renderer, scene, cameras[:1])
        for _ in range(repeats):
            for count, poses in spread.items():
                started = time.perf_counter()
                gather_statistics(renderer, scene, poses)
                times[count].append(time.perf_counter() - started)
    renderer.release()
    return [
        {"kind": "views", "amount": count, "ms": round(1e3 * min(found), 3), **_columns({})}
        for count, found in times.items()
    ]


def _experiment(studied: StudyScene, rows: list[dict[str, Cell]], repeats: int) -> Experiment:
    table = Table(
        columns(
            kind="what grows",
            amount="amount",
            ms="ms",
            **{name.replace(" ", "_"): f"{name}, ms" for name in STAGES},
        ),
        tuple(rows),
    )
    series, findings = [], []
    for kind in dict.fromkeys(str(row["kind"]) for row in rows):
        amounts, times = table.values("amount", kind=kind), table.values("ms", kind=kind)
        whole = amounts.index(_whole(studied, kind, amounts))
        relative = [amount / amounts[whole] for amount in amounts]
        series.append(Series(kind, relative, [round(found / times[whole], 5) for found in times]))
        if len(amounts) > 1:
            findings.append(_words(table, kind, amounts, times))
    camera = studied.judge.cameras[0]
    return Experiment(
        "scaling",
        "How times grow",
        f"Gaussians and pixels: ms of a view, mean of the {len(studied.judge.cameras)} deciding ones, drawn and read back. "
        "Stages are timed with a wait after every kernel, so their sum may be larger. Gaussians are left out at "
        "random, so fewer of them cover less of the picture. Pixels: both sides times "
        f"{', '.join(f'{side:g}' for side in SIDES)} from {camera.width}x{camera.height}. Views: ms of counting hits and "
        f"weights over so many training poses. Times are the shortest of {repeats} rounds. An exponent is the slope of the "
        "logarithms over all amounts.",
        table,
        LineChart(
            "Times of parts and multiples of the scene's own amounts",
            "amount, of the scene's own (log)",
            "time, of the scene's own (log)",
            tuple(series),
            log_x=True,
            log_y=True,
        ),
        tuple(findings),
        timed=True,
    )


def _whole(studied: StudyScene, kind: str, amounts: list[int]) -> int:
    """The amount of the whole scene."""
    cameras = studied.judge.cameras
    pixels = sum(camera.width * camera.height for camera in cameras) // len(cameras)
    return pixels if kind == "pixels" else max(amounts)


def _words(table: Table, kind: str, amounts: list[int], times: list[float]) -> str:
    ends = f"{amounts[0]} {kind}: {times[0]:.2f} ms, {amounts[-1]}: {times[-1]:.2f} ms; exponent {slope(amounts, times):.2f}"
    parts = []
    for name in STAGES:
        found = table.values(name.replace(" ", "_"), kind=kind)
        if all(found):
            parts.append(f"{name} {slope(amounts, found):.2f}")
    return ends + (f" ({', '.join(parts)})." if parts else ".")
