"""Experiments on pruning: ADP against pruning only rows or only SH, all pairs of the two rates, and the two scores."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.paper.charts import PlaneChart
from benchmarks.paper.scene import Point, Setting, StudyScene, beside
from flexgs_edge.goals.steps import Choice
from flexgs_edge.methods.paper.search import CANDIDATES
from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.studies.written import FIGURES, Cell, Experiment, Table, number

DIAGONAL = tuple(range(50, 501, 50))  # Rates p = s of the ADP curve, in thousandths. Nothing was tuned for this split.
GRID = 100  # Step of the rates in `plane`, in thousandths. The paper's candidates lie on this grid.
MAX_ROWS = 980  # Largest rate of pruning rows alone, in thousandths
RATES = {"prune_rate": "p (removed)", "sh_rate": "s (SH removed)"}


def candidates(studied: StudyScene) -> list[Choice]:
    """The paper's candidates, from most to fewest bytes."""
    choices = [Choice(100 * p, 100 * s) for p, s in CANDIDATES]
    return sorted(choices, key=lambda choice: (-studied.size(Setting(choice)), choice))


def nearest(sizes: Sequence[int], size: int) -> int | None:
    """Index of the size nearest to `size` in `sizes` (falling); `None` when out of reach.

    A size is out of reach if it lies beyond an end by more than half of the step there.

    >>> nearest([90, 50, 10], 40), nearest([90, 50, 10], 0), nearest([90, 50, 10], -20)
    (1, 2, None)
    """
    best = min(range(len(sizes)), key=lambda i: (abs(sizes[i] - size), i))
    end = best in (0, len(sizes) - 1)
    step = abs(sizes[best] - sizes[best - 1 if best else 1])
    return None if end and abs(sizes[best] - size) > step / 2 else best


def splits(studied: StudyScene) -> Experiment:
    """Compare ADP with row pruning only (Row-P) and SH pruning only (SH-P) at equal bytes."""
    families = {
        "Row-P": [Choice(rate, 0) for rate in range(MAX_ROWS + 1)],
        "SH-P": [Choice(0, rate) for rate in range(1001)],
    }
    ladders = {name: [studied.size(Setting(choice)) for choice in family] for name, family in families.items()}
    levels = [("ADP p=s", Choice(rate, rate)) for rate in DIAGONAL]
    levels += [("ADP candidate", choice) for choice in candidates(studied)]
    wanted: list[tuple[str, str, Choice]] = []
    for kind, choice in levels:
        wanted.append((kind, kind, choice))
        for family, members in families.items():
            equal = nearest(ladders[family], studied.size(Setting(choice)))
            if equal is not None:
                wanted.append((kind, family, members[equal]))
    found = studied.points([Setting(choice) for _, _, choice in wanted], "splits")
    rows: list[dict[str, Cell]] = []
    for (level, method, choice), point in zip(wanted, found):
        if level == method:
            equal_to = point.size
        rows.append({"level": level, "equal_to": equal_to, "method": method, **_rates(choice), **studied.cells(point)})
    heads = dict(level="bytes as", equal_to="bytes wanted", method="method", **RATES, **FIGURES)
    table = Table(heads, tuple(rows))
    figure = studied.figure

    def series(label: str, level: str, method: str, line: bool = True) -> Series:
        where = {"level": level, "method": method}
        return Series(label, table.values("ratio", **where), table.values(figure, **where), line)

    return Experiment(
        "splits",
        "ADP against row pruning and SH pruning at equal bytes",
        "All files have the paper's bits. ADP removes a share p of the Gaussians and the SH of a further share s. Row-P and SH-P "
        "do one of the two, at the rate (in thousandths) whose file is nearest in bytes. SH-P ends when all SH are removed.",
        table,
        LineChart(
            "Removing Gaussians and SH (ADP), Gaussians only, SH only",
            "ratio to the PLY",
            FIGURES[figure],
            (
                series("ADP, p = s", "ADP p=s", "ADP p=s"),
                series("Row-P: Gaussians only", "ADP p=s", "Row-P"),
                series("SH-P: SH only", "ADP p=s", "SH-P"),
                series("ADP, the paper's 20 candidates", "ADP candidate", "ADP candidate", line=False),
            ),
            limit=getattr(studied.target, "limit", None),
            doublings=True,
            magnitudes=True,
        ),
        tuple(_wins(rows, level, family, figure) for level in ("ADP p=s", "ADP candidate") for family in families),
    )


def _wins(rows: Sequence[dict[str, Cell]], level: str, family: str, figure: str) -> str:
    """At how many sizes ADP loses less than `family`, and by how much on average."""
    gaps: list[float] = []
    apart = 0.0
    own: dict[str, Cell] = {}
    for row in rows:
        if row["level"] == level and row["method"] == level:
            own = row
        elif row["level"] == level and row["method"] == family:
            gaps.append(number(row, figure) - number(own, figure))
            apart = max(apart, abs(number(row, "size") / number(own, "size") - 1))
    if not gaps:
        return f"{level}: {family} reaches none of these sizes."
    better = sum(gap > 0 for gap in gaps)
    return (
        f"{level}: loses less than {family} at {better} of the {len(gaps)} sizes that both reach; {family} loses "
        f"{sum(gaps) / len(gaps):+.3f} dB more than ADP on average ({min(gaps):+.3f} to {max(gaps):+.3f}). "
        f"Bytes differ by at most {100 * apart:.2f} %."
    )


def plane(studied: StudyScene) -> Experiment:
    """Measure the loss over all (p, s), and show where the target lies and how the search went."""
    search = studied.search
    line = range(0, 1000, GRID)
    cells = [Choice(p, s) for p in line for s in range(0, 1001 - p, GRID)]
    found = {point.setting.choice: point for point in studied.points([Setting(choice) for choice in cells], "plane")}
    listed = set(candidates(studied))
    rows: list[dict[str, Cell]] = [
        {"kind": "candidate" if choice in listed else "cell", "step": None, **_rates(choice), **studied.cells(point)}
        for choice, point in found.items()
    ]
    for turn, step in enumerate(search.steps, 1):
        assert step.measurement is not None
        # Steps of the list and of the refinement are estimates, because the search saw only these.
        kind = "answer" if step is search.chosen else step.phase
        rows.append({"kind": kind, "step": turn, **_rates(step.choice), **studied.figures(step.size, step.measurement)})
    figure = studied.figure
    limit = getattr(studied.target, "limit", None)
    assert isinstance(limit, float)
    empty: dict[str, Cell] = dict.fromkeys(FIGURES)
    frontier = _frontier({choice: _loss(studied, point) for choice, point in found.items()}, limit)
    for p, s in frontier:
        choice = Choice(round(1000 * p), min(round(1000 * s), 1000 - round(1000 * p)))
        size = studied.size(Setting(choice))
        ratio = round(studied.run.scene.ply_bytes / size, 3)
        rows.append(
            {"kind": "frontier", "step": None, "prune_rate": p, "sh_rate": s, **empty, "size": size, "ratio": ratio}
        )
    table = Table(dict(kind="kind", step="step", **RATES, **FIGURES), tuple(rows))
    grid = [row for row in rows if row["kind"] in ("cell", "candidate")]
    chosen = studied.point(Setting(search.chosen.choice))
    answer = studied.cells(chosen)
    words = f"{studied.plan.figure} = {limit:g} dB"
    return Experiment(
        "plane",
        "The plane of the two rates, and the search on it",
        f"Every cell is a measured file at the paper's bits. The line is where the {words}, interpolated between cells. Dots "
        f"are the paper's candidates. The path shows the search for {studied.target.describe()} "
        f"(effort {studied.run.options.effort}).",
        table,
        PlaneChart(
            "Loss over the two rates, and the steps of the search",
            "p: share of the Gaussians removed",
            "s: further share of Gaussians that lose their SH",
            FIGURES[figure],
            {(number(row, "prune_rate"), number(row, "sh_rate")): number(row, figure) for row in grid},
            GRID / 1000,
            2.0 * limit,
            frontier,
            words,
            _places(row for row in rows if row["kind"] == "candidate"),
            _places(row for row in rows if row["step"] is not None),
            _places(row for row in rows if row["kind"] == "answer")[0],
        ),
        (
            _monotone(found, studied),
            _slope(frontier, studied),
            f"The search took {len(search.steps)} steps and chose p = {search.chosen.choice.prune / 1000:g}, "
            f"s = {search.chosen.choice.sh / 1000:g}: {answer['ratio']}x at {answer[figure]:.3f} dB"
            + ("." if search.reached else " (the target is NOT reached: this is the closest point)."),
            beside("ratio at the search's answer", f"{answer['ratio']:.1f}x", "19.5x to 28x"),
            beside(
                "smaller by, and loss there",
                f"{100 * (1 - chosen.size / studied.run.scene.ply_bytes):.1f} %, {answer[figure]:.2f} dB",
                "94.9 / 96.1 / 96.4 %, 0.87 / 0.86 / 0.85 dB (Mip-NeRF360 / Tanks&Temples / Deep Blending)",
            ),
        ),
    )


def _frontier(losses: dict[Choice, float], limit: float) -> list[tuple[float, float]]:
    """For each s of the grid, the interpolated p at which the loss first exceeds `limit`; no entry if it never does."""
    found = []
    for s in sorted({choice.sh for choice in losses}):
        line = sorted((choice.prune, loss) for choice, loss in losses.items() if choice.sh == s)
        for (p, loss), (q, more) in zip(line, line[1:]):
            if loss <= limit < more:
                found.append((round((p + (q - p) * (limit - loss) / (more - loss)) / 1000, 4), s / 1000))
                break
    return found


def _monotone(found: dict[Choice, Point], studied: StudyScene) -> str:
    """How often more pruning loses less, among neighbouring cells and along the sorted list."""
    rises = []
    for choice, point in found.items():
        for more in ((choice.prune + GRID, choice.sh), (choice.prune, choice.sh + GRID)):
            other = found.get(Choice(*more)) if sum(more) <= 1000 else None
            if other is not None:
                rises.append(_loss(studied, other) - _loss(studied, point))
    fell = [rise for rise in rises if rise < 0]
    walk = [_loss(studied, found[choice]) for choice in candidates(studied)]
    back = [b - a for a, b in zip(walk, walk[1:]) if b < a]
    return (
        f"More pruning loses more between {len(rises) - len(fell)} of {len(rises)} neighbouring cells"
        + (f" (else at most {-min(fell):.3f} dB less)" if fell else "")
        + f"; along the list, sorted by bytes, between {len(walk) - 1 - len(back)} of {len(walk) - 1}"
        + (f" (else at most {-min(back):.3f} dB less)." if back else ".")
    )


def _slope(frontier: Sequence[tuple[float, float]], studied: StudyScene) -> str:
    """The slope of the frontier, compared with lines of equal bytes."""
    if len(frontier) < 2:
        return f"The target lies on fewer than two rows of the plane ({len(frontier)}): no frontier to speak of."
    (p, s), (q, t) = frontier[0], frontier[-1]
    across = f"{(q - p) / (t - s):.2f} in p for each s"
    sizes = [studied.size(Setting(choice)) for choice in (Choice(0, 0), Choice(100, 0), Choice(0, 100))]
    equal = -(sizes[0] - sizes[2]) / (sizes[0] - sizes[1])
    best = min(frontier, key=lambda at: studied.size(Setting(Choice.from_rates(*at))))
    return (
        f"The frontier goes from (p, s) = ({p:.2f}, {s:g}) to ({q:.2f}, {t:g}): {across} (at equal bytes: {equal:.2f}); of its "
        f"points ({best[0]:.2f}, {best[1]:g}) has the fewest bytes."
    )


def scores(studied: StudyScene) -> Experiment:
    """Compare the scores gs (hits) and meson (weights) at the paper's candidates."""
    kinds = ("gs", "meson")
    wanted = [Setting(choice, score=score) for choice in candidates(studied) for score in kinds]
    rows: list[dict[str, Cell]] = [
        {"score": point.setting.score, **_rates(point.setting.choice), **studied.cells(point)}
        for point in studied.points(wanted, "scores")
    ]
    table = Table(dict(score="score", **RATES, **FIGURES), tuple(rows))
    figure = studied.figure
    gs, meson = (table.values(figure, score=score) for score in kinds)
    gaps = [b - a for a, b in zip(gs, meson)]
    half = studied.run.source.count // 2
    low = np.zeros(studied.run.source.count, bool)
    low[studied.orders["gs"][:half]] = True
    same = low[studied.orders["meson"][:half]].sum() / max(half, 1)
    return Experiment(
        "scores",
        "Ranking by gs or by meson",
        "The paper's 20 candidates at its bits, from the same training poses. gs: opacity, volume and pixels hit; meson: volume "
        "and the sum of blending weights.",
        table,
        LineChart(
            "The two scores at the paper's candidates",
            "ratio to the PLY",
            FIGURES[figure],
            tuple(
                Series(score, table.values("ratio", score=score), table.values(figure, score=score), line=False)
                for score in kinds
            ),
            doublings=True,
            magnitudes=True,
        ),
        (
            f"meson loses less at {sum(gap < 0 for gap in gaps)} of {len(gaps)} candidates; it loses "
            f"{sum(gaps) / len(gaps):+.3f} dB more than gs on average ({min(gaps):+.3f} to {max(gaps):+.3f}). "
            f"The two scores share {100 * same:.0f} % of the lower half of the ranks.",
        ),
    )


def _rates(choice: Choice) -> dict[str, Cell]:
    return {"prune_rate": choice.prune / 1000, "sh_rate": choice.sh / 1000}


def _loss(studied: StudyScene, point: Point) -> float:
    return point.measurement.loss(studied.plan.figure)


def _places(rows: object) -> list[tuple[float, float]]:
    return [(number(row, "prune_rate"), number(row, "sh_rate")) for row in rows]  # type: ignore[attr-defined]
