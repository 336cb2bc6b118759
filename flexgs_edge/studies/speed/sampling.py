"""Tests estimates of quality from a part of the tiles: width of the interval, how often it holds, and time saved."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from flexgs_edge.goals.choice import Choice
from flexgs_edge.quality.psnr import mse
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.studies.experiment import Experiment
from flexgs_edge.studies.result_tables import Cell, Table, columns, mean
from flexgs_edge.studies.speed.tile_sampling import Estimate, TileSampler, tile_errors, tile_values
from flexgs_edge.studies.speed.timing import draw_seconds, stage_seconds
from flexgs_edge.studies.study_scene import Setting, StudyScene

SHARES = (0.05, 0.1, 0.2, 0.5, 1.0)
TRIALS = 200
ROUNDS = 3
"""Rounds of timing a whole measurement. The shortest time counts."""
BY_PLACE = "nothing"
FIRST, NEAREST = "first step", "nearest step"


@dataclass(frozen=True)
class Costs:
    """Seconds that measuring one whole view takes.

    Parameters
    ----------
    fixed : float
        Work for the whole view: projection, sorting, tile lists.
    by_pixels : float
        Work that grows with the share of tiles: blending and comparing.
    compare : float
        The part of `by_pixels` for comparing.
    """

    fixed: float
    by_pixels: float
    compare: float

    def at(self, share: float) -> float:
        """Seconds of a view if a share of its tiles is blended and compared."""
        return self.fixed + share * self.by_pixels


def sampling(studied: StudyScene, trials: int = TRIALS) -> Experiment:
    """Measure intervals from samples of every size, with and without an expected error map."""
    chosen = studied.search.chosen.choice
    maps, costs = _maps(studied, chosen, timed=True)
    assert costs is not None
    values = [tile_values(camera.height, camera.width) for camera in studied.judge.cameras]
    known: dict[str, list[np.ndarray] | None] = {BY_PLACE: None}
    words = []
    for name, choice in _earlier(studied, chosen).items():
        known[name] = _maps(studied, choice)[0]
        loss = studied.point(Setting(choice)).measurement.modelled_drop
        words.append(f"{name}: p = {choice.prune / 1000:g}, s = {choice.sh / 1000:g}, modelled drop {loss:.2f} dB")
    truth = studied.point(Setting(chosen)).measurement.fidelity
    rows: list[dict[str, Cell]] = []
    for name, expected in known.items():
        for share in SHARES:
            found = trial_estimates(values, maps, expected, share, trials)
            rows.append(_row(name, share, found, truth, costs))
    return _experiment(studied, rows, trials, truth, costs, chosen, words)


def trial_estimates(
    values: Sequence[np.ndarray],
    maps: Sequence[np.ndarray],
    expected: Sequence[np.ndarray] | None,
    share: float,
    trials: int,
) -> list[Estimate]:
    """Estimates from `trials` samples (seeds 0, 1, ...) of error maps that are known as a whole."""
    sampler = TileSampler(values, share, expected)
    errors = np.concatenate(maps)
    drawn = (sampler.draw(seed) for seed in range(trials))
    return [sampler.estimate(tiles, errors[tiles]) for tiles in drawn]


def _earlier(studied: StudyScene, chosen: Choice) -> dict[str, Choice]:
    """Steps of the search whose error maps may predict where the errors of its answer are."""
    steps = studied.search.steps
    place = next(i for i, step in enumerate(steps) if step.choice == chosen)
    before = [step for step in steps[:place] if step.measurement is not None]
    if not before:
        return {}
    loss = studied.point(Setting(chosen)).measurement.modelled_drop
    nearest = min(before, key=lambda step: abs(step.measurement.modelled_drop - loss) if step.measurement else math.inf)
    found = {FIRST: before[0].choice}
    if nearest.choice != before[0].choice:
        found[NEAREST] = nearest.choice
    return found


def _maps(studied: StudyScene, choice: Choice, timed: bool = False) -> tuple[list[np.ndarray], Costs | None]:
    """Squared errors by tile of each deciding view; with `timed` also the seconds of measuring."""
    judge, renderer = studied.judge, studied.bench.renderer
    evaluator = studied.evaluator(Setting(choice))
    with evaluator.quantized(choice) as quantized, renderer.load_quantized(quantized) as scene:
        maps, compare = [], 0.0
        for i, camera in enumerate(judge.cameras):
            image, original = renderer.render(scene, camera), judge.original(i)
            maps.append(tile_errors(image, original))
            if timed:
                compare += min(_compare_seconds(image, original) for _ in range(ROUNDS))
        if not timed:
            return maps, None
        views = len(judge.cameras)
        whole = min(draw_seconds(renderer, scene, judge.cameras) for _ in range(ROUNDS)) / views
        rounds = [stage_seconds(renderer, scene, judge.cameras) for _ in range(ROUNDS)]
        stages = {name: min(found[name] for found in rounds) for name in rounds[0]}
    blend = whole * stages["blend"] / max(sum(stages.values()), 1e-9)
    return maps, Costs(whole - blend, blend + compare / views, compare / views)


def _compare_seconds(image: np.ndarray, original: np.ndarray) -> float:
    started = time.perf_counter()
    mse(image, original)
    return time.perf_counter() - started


def _row(name: str, share: float, found: Sequence[Estimate], truth: float | None, costs: Costs) -> dict[str, Cell]:
    looked = mean([estimate.share for estimate in found])
    off = [
        0.0 if truth is None or estimate.fidelity is None else (estimate.fidelity - truth) ** 2 for estimate in found
    ]
    return {
        "known": name,
        "asked": share,
        "looked": round(looked, 4),
        "ms": round(1e3 * costs.at(looked), 3),
        "trials": len(found),
        "covered": sum(estimate.covers(truth) for estimate in found),
        "half_width": round(mean([estimate.half_width for estimate in found]), 4),
        "rms": round(math.sqrt(mean(off)), 4),
    }


def _experiment(
    studied: StudyScene,
    rows: list[dict[str, Cell]],
    trials: int,
    truth: float | None,
    costs: Costs,
    chosen: Choice,
    words: Sequence[str],
) -> Experiment:
    table = Table(
        columns(
            known="known before",
            asked="share asked for",
            looked="pixels looked at",
            ms="ms a view (computed)",
            trials="trials",
            covered="of them, interval holds",
            half_width="mean half-width (dB)",
            rms="RMS error (dB)",
        ),
        tuple(rows),
    )
    whole = costs.at(1.0)
    names = list(dict.fromkeys(str(row["known"]) for row in rows))
    full = "identical" if truth is None else f"{truth:.3f} dB"
    return Experiment(
        "sampling",
        "Fidelity from a part of the tiles",
        f"The answer of the paper's search (p = {chosen.prune / 1000:g}, s = {chosen.sh / 1000:g}; fidelity {full} when "
        f"measured whole) over the {len(studied.judge.cameras)} deciding views, estimated {trials} times from some tiles of "
        "complete error maps. Tiles of a view are cut into strata of equal expected error, and two are drawn from each. "
        f"Errors are expected from another step of the search ({'; '.join(words) or 'it had none before its answer'}); "
        "with nothing known, strata are runs of neighbours. The 95 % interval is by the delta method. The renderer "
        "draws whole views, so the time is computed: the measured time of a view without blending, and the share of "
        "blending and comparing.",
        table,
        LineChart(
            "Time of a measurement against the width of its interval",
            "ms a view (computed)",
            "half-width of the 95 % interval (dB)",
            tuple(
                Series(
                    f"known before: {name}",
                    table.values("ms", known=name),
                    table.values("half_width", known=name),
                    notes=[
                        f"{100 * share:g} %" if name == BY_PLACE else "" for share in table.values("asked", known=name)
                    ],
                )
                for name in names
            ),
        ),
        (
            *(_words(rows, name) for name in names),
            f"A view takes {1e3 * whole:.1f} ms to draw and compare, {1e3 * costs.by_pixels:.1f} of them blending and comparing "
            f"({1e3 * costs.compare:.1f}); from 20 % of the tiles it would take {costs.at(0.2) / whole:.0%} of the time.",
        ),
        timed=True,
    )


def _words(rows: Sequence[dict[str, Cell]], name: str) -> str:
    parts = [
        f"{100 * float(row['asked'] or 0):g} % +-{row['half_width']:.3f} dB, holds in {row['covered']} of {row['trials']}"
        for row in rows
        if row["known"] == name and row["asked"] != 1.0
    ]
    return f"Known before: {name}: {'; '.join(parts)}."
