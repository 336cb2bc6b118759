"""Experiments on bytes and quality: all methods side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from flexgs_edge.report.plots import LineChart, Series
from flexgs_edge.studies.rate.points import WHOLE, RatePoint, loss_of, point_columns, point_row
from flexgs_edge.studies.result_tables import Cell, Experiment, Table, mean
from flexgs_edge.studies.study_scene import FIGURES, StudyScene

LEAST_LOSS = 0.001
"""Points with less loss than this, in dB, are left out. Loss and bytes are interpolated on log scales, because such curves are
nearly power laws."""
SLACK = 1e-9  # Tolerance, so that the curve's own points lie on it in spite of rounding
FIDELITY_WORDS = "fidelity: PSNR against the original's renders"


class Curve:
    """Bytes and loss of one method at several sizes.

    `points`: bytes and dB.
    """

    def __init__(self, points: Iterable[tuple[int, float]]) -> None:
        known = sorted((size, loss) for size, loss in points if loss >= LEAST_LOSS)
        self._sizes = np.log([size for size, _ in known])
        # With noise a smaller file may be the better one. The smaller file then counts.
        self._losses = np.minimum.accumulate(np.log([loss for _, loss in known]))

    def loss(self, size: int) -> float | None:
        """Loss in dB of a file of `size` bytes; None beyond the curve's ends."""
        place = float(np.log(size))
        if not len(self._sizes) or not self._sizes[0] - SLACK <= place <= self._sizes[-1] + SLACK:
            return None
        return float(np.exp(np.interp(place, self._sizes, self._losses)))

    def size(self, loss: float) -> float | None:
        """Fewest bytes at `loss` dB; None beyond the curve's ends."""
        place = float(np.log(max(loss, 1e-12)))
        if not len(self._sizes) or not self._losses[-1] - SLACK <= place <= self._losses[0] + SLACK:
            return None
        after = int(np.flatnonzero(self._losses <= place + SLACK)[0])
        if after == 0:
            return float(np.exp(self._sizes[0]))
        ends = slice(after - 1, after + 1)
        return float(np.exp(np.interp(-place, -self._losses[ends], self._sizes[ends])))


def rate(studied: StudyScene, points: Sequence[RatePoint], missing: Sequence[str], effort: str) -> Experiment:
    """Compare all methods by bytes and the deciding figure. The table holds all points of the study."""
    table = Table(point_columns(), tuple(point_row(studied, point) for point in points))
    with_photos = studied.plan.figure == "drop"
    figure = studied.figure if with_photos else "fidelity"
    against = "PSNR, SSIM and FLIP are against the photos"
    if not with_photos:
        against = "SSIM and FLIP are against the original: there are no photos"
    findings = list(_comparisons(studied, points, effort))
    if missing:
        findings.append(f"Left out or not reached: {'; '.join(missing)}.")
    return Experiment(
        "rate",
        "Bytes and quality",
        f"Every method at the sizes asked for: best at the effort {effort}, paper with "
        "its rates to choose, and the whole scene in the formats of other programs as this one writes them. "
        f"{against}; {FIDELITY_WORDS}. "
        "The first seconds of a curve include most of the rounds of pruning, which its other points share.",
        table,
        _chart(table, "Bytes and quality", figure, effort),
        tuple(findings),
        timed=True,
    )


def fidelity(studied: StudyScene, points: Sequence[RatePoint], effort: str) -> Experiment:
    """Compare all methods by bytes and fidelity to the original's renders, for scenes that photos decide."""
    names = ("method", "wanted_ratio", "variant", "effort", "size", "ratio", "fidelity")
    rows = [
        point_row(studied, point) for point in points if _on_curve(point.method, point.variant, point.effort, effort)
    ]
    heads = {column.name: column for column in point_columns()}
    table = Table(tuple(heads[name] for name in names), tuple({name: row[name] for name in names} for row in rows))
    return Experiment(
        "fidelity",
        "Bytes and fidelity",
        f"The same files; {FIDELITY_WORDS}, which shows all errors. A drop against photos hides those that come nearer to one.",
        table,
        _chart(table, "Bytes and fidelity", "fidelity", effort),
        (
            "Fidelity of best: "
            + ", ".join(f"{row['fidelity']:.1f} dB at {row['ratio']:.0f}x" for row in rows if row["method"] == "best")
            + ".",
        ),
    )


def _on_curve(method: str, variant: str, effort: str | None, wanted: str) -> bool:
    return method != "best" or (variant == WHOLE and effort == wanted)


def _chart(table: Table, title: str, figure: str, effort: str) -> LineChart:
    series: dict[str, list[dict[str, Cell]]] = {}
    for row in table.rows:
        method = str(row["method"])
        if _on_curve(method, str(row["variant"]), None if row["effort"] is None else str(row["effort"]), effort):
            series.setdefault(method, []).append(dict(row))
    floating = figure == "fidelity"
    return LineChart(
        title,
        "bytes of the file, MB (log)",
        FIGURES[figure],
        tuple(
            Series(
                name,
                [float(row["size"] or 0) / 1e6 for row in rows],
                [None if row[figure] is None else float(row[figure] or 0.0) for row in rows],
                notes=[_note(row) for row in rows] if rows[0]["method"] in ("best", "paper") else [name] * len(rows),
            )
            for name, rows in series.items()
        ),
        megabytes=True,
        floating=floating,
        magnitudes=not floating,
    )


def _note(row: dict[str, Cell]) -> str:
    return "" if row["wanted_ratio"] is None or row["method"] != "best" else f"{row['wanted_ratio']:g}x"


def _comparisons(studied: StudyScene, points: Sequence[RatePoint], effort: str) -> Iterable[str]:
    """Sentences that compare best with each other method and effort, at equal loss."""
    figure = FIGURES[studied.figure].removesuffix(" (dB)")
    best = _points(points, "best", WHOLE, effort)
    paper = {point.wanted: point for point in _points(points, "paper", WHOLE, effort)}
    pairs = [(point, paper[point.wanted]) for point in best if point.wanted in paper]
    if pairs:
        words = ", ".join(f"{a.wanted:g}x: {loss_of(studied, a):.2f} / {loss_of(studied, b):.2f} dB" for a, b in pairs)
        yield f"{figure.capitalize()} of best / paper at equal ratios: {words}."
    curve = _curve(studied, best)
    shares = [share for share in (_share(studied, curve, point) for point in paper.values()) if share is not None]
    if shares:
        yield (
            f"At equal {figure} best needs {min(shares):.0%} to {max(shares):.0%} of paper's bytes "
            f"({len(shares)} of paper's {len(paper)} points lie on its curve)."
        )
    for point in points:
        if point.method not in ("best", "paper"):
            share, loss = _share(studied, curve, point), loss_of(studied, point)
            than = (
                f"best needs {share:.0%} of its bytes there" if share is not None else "beyond the ends of best's curve"
            )
            yield f"{point.method}: {studied.run.scene.ply_bytes / point.size:.1f}x at {loss:.3f} dB of {figure}; {than}."
    others = sorted({p.effort for p in points if p.effort not in (None, effort) and p.variant == WHOLE} - {None})
    whole = _modelled(best)
    for other in others:
        # Efforts differ by few bytes. The drop against photos is too noisy to tell.
        known = [_more(p.size, whole.size(p.quality.modelled_drop)) for p in _points(points, "best", WHOLE, other)]
        costs = [cost for cost in known if cost is not None]
        if costs:
            yield (
                f"The effort {other}: {mean(costs):+.1f} % bytes at equal modelled drop against {effort} "
                f"(mean of {len(costs)} sizes)."
            )


def _points(points: Iterable[RatePoint], method: str, variant: str, effort: str | None) -> list[RatePoint]:
    return [p for p in points if (p.method, p.variant, p.effort) == (method, variant, effort)]


def _curve(studied: StudyScene, points: Iterable[RatePoint]) -> Curve:
    return Curve((point.size, loss_of(studied, point)) for point in points)


def _modelled(points: Iterable[RatePoint]) -> Curve:
    return Curve((point.size, point.quality.modelled_drop) for point in points)


def _share(studied: StudyScene, curve: Curve, point: RatePoint) -> float | None:
    """Bytes on the curve at the point's loss, divided by the point's bytes."""
    size = curve.size(loss_of(studied, point))
    return None if size is None else size / point.size


def _more(size: int, whole: float | None) -> float | None:
    """By how many per cent `size` is larger than `whole`."""
    return None if whole is None else round(100 * size / whole - 100, 2) + 0.0  # no -0.0
