"""Experiments on quantization: equal bits for all channels, each attribute alone, and sub-groups."""

from __future__ import annotations

from dataclasses import replace

from benchmarks.paper.charts import DotChart
from benchmarks.paper.scene import Setting, StudyScene
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.report.plots import BarChart, LineChart, Series
from flexgs_edge.run.run import EVERYTHING
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.studies.written import FIGURES, Cell, Experiment, Table

RTN_BITS = tuple(range(2, 9))
FINE = BitSpec.rtn(16)  # Stands for unquantized values: 16 bits in sub-groups lose less than renders show
ALONE_BITS = (4, 8)
PAPER_GROUPS = 1000
NAMES = {"xyz": "position", "dc": "colour", "rest": "SH", "opacity": "opacity", "scale": "scale", "rot": "rotation"}
"""Plain names of the attributes of `--bits`."""


def rtn(studied: StudyScene) -> Experiment:
    """Compare rounding at one width for all channels with the paper's widths in sub-groups."""
    plain = studied.points([Setting(bits=BitSpec.rtn(bits), groups=1) for bits in RTN_BITS], "RTN")
    rows: list[dict[str, Cell]] = [
        {"coding": "RTN", "bits": bits, **studied.cells(point)} for bits, point in zip(RTN_BITS, plain)
    ]
    rows.append({"coding": "MPQ", "bits": None, **studied.cells(studied.point(Setting()))})
    table = Table(dict(coding="coding", bits="bits a value", **FIGURES), tuple(rows))
    figure = studied.figure

    def series(label: str, coding: str, notes: list[str]) -> Series:
        sizes = [size / 1e6 for size in table.values("size", coding=coding)]
        return Series(label, sizes, table.values(figure, coding=coding), line=bool(notes), notes=notes)

    best, mixed = rows[-2], rows[-1]
    return Experiment(
        "rtn",
        "Round to nearest at 2 to 8 bits",
        "All Gaussians stay. RTN codes every value with the same number of bits, with one range for each channel of the whole "
        "scene; MPQ is the paper's widths (16 bits for positions, 8 for colour, scale and rotation, 4 for opacity and SH) "
        "with a range for each sub-group.",
        table,
        LineChart(
            "Round to nearest (RTN) and the paper's mixed precision (MPQ)",
            "file size (MB), nothing pruned",
            FIGURES[figure],
            (
                series("RTN: one width, one range a channel", "RTN", [f"{bits} bits" for bits in RTN_BITS]),
                series("MPQ: 16/8/4 bits in sub-groups", "MPQ", []),
            ),
        ),
        (
            f"RTN at 8 bits, its best, loses {best[figure]:.3f} dB in {_mb(best)}; MPQ loses {mixed[figure]:.3f} dB in "
            f"{_mb(mixed)}.",
        ),
    )


def attributes(studied: StudyScene) -> Experiment:
    """Quantize each attribute alone to 4 and to 8 bits, with all others at 16."""
    names = [field.bits for field in FIELDS if field.width(studied.run.source.sh_degree)]
    alone = [(name, bits) for name in names for bits in ALONE_BITS]
    settings = [Setting(bits=replace(FINE, **{name: bits})) for name, bits in alone]
    floor, *found = studied.points([Setting(bits=FINE), *settings], "attributes")
    rows: list[dict[str, Cell]] = [
        {"attribute": name, "bits": bits, **studied.cells(point), "rise": _scientific(studied.error(point) - base)}
        for base in [studied.error(floor)]
        for (name, bits), point in zip(alone, found)
    ]
    rows.insert(0, {"attribute": "none", "bits": 16, **studied.cells(floor), "rise": 0.0})
    heads = dict(attribute="attribute", bits="bits", **FIGURES, rise="rise of the squared error")
    table = Table(heads, tuple(rows))
    figure = studied.figure
    losses = {bits: table.values(figure, bits=bits) for bits in ALONE_BITS}
    worst = max(rows, key=lambda row: float(row["rise"] or 0.0))
    mildest = min((row for row in rows if row["bits"] == 4), key=lambda row: float(row["rise"] or 0.0))
    return Experiment(
        "attributes",
        "Each attribute alone at 4 and at 8 bits",
        "All Gaussians stay, with a range for each sub-group; the other attributes have 16 bits, which by itself loses "
        f"{rows[0][figure]:.4f} dB. The rise is that of the mean squared error against the original's renders.",
        table,
        DotChart(
            f"One attribute at 4 or 8 bits, all others at 16 (beside the dots: {studied.plan.figure} in dB)",
            "rise of the squared error against the original's renders",
            [NAMES[name] for name in names],
            {f"{bits} bits": table.values("rise", bits=bits) for bits in ALONE_BITS},
            {f"{bits} bits": [_short(loss) for loss in found] for bits, found in losses.items()},
        ),
        (
            f"At 4 bits {NAMES[str(worst['attribute'])]} hurts most ({worst[figure]:.3f} dB) and "
            f"{NAMES[str(mildest['attribute'])]} least ({mildest[figure]:.3f} dB).",
        ),
    )


def groups(studied: StudyScene) -> Experiment:
    """Compare one range a channel, sub-groups that follow N, and the paper's 1000, at the same bits."""
    choices = {"nothing": EVERYTHING, "as the search chose": studied.search.chosen.choice}
    kinds: dict[str, int | None] = {"one": 1, "default": None, "paper": PAPER_GROUPS}
    wanted = [Setting(choice, PAPER, count) for choice in choices.values() for count in kinds.values()]
    found = iter(studied.points(wanted, "groups"))
    rows: list[dict[str, Cell]] = []
    for pruned, choice in choices.items():
        for kind in kinds:
            point = next(found)
            plain = studied.size(Setting(choice, PAPER, 1))
            rows.append(
                {
                    "pruned": pruned,
                    "groups": kind,
                    "extra_bytes": point.size - plain,
                    **studied.cells(point),
                    "error": _scientific(studied.error(point)),
                }
            )
    heads = dict(
        pruned="pruned", groups="groups", extra_bytes="bytes beyond one group", **FIGURES, error="squared error"
    )
    table = Table(heads, tuple(rows))
    figure = studied.figure
    one, default, paper = rows[:3]
    labels = {"one": "one range", "default": "one for 512 rows", "paper": f"{PAPER_GROUPS} (paper)"}
    return Experiment(
        "groups",
        "With and without sub-groups",
        "The paper's bits. One range for each channel of the whole scene; one for about 512 rows (the default); the paper's "
        f"{PAPER_GROUPS} whatever the number of rows. The squared error is against the original's renders.",
        table,
        BarChart(
            "Ranges for each channel, at the paper's bits",
            FIGURES[figure],
            ["nothing pruned", "pruned as the search chose"],
            {label: table.values(figure, groups=kind) for kind, label in labels.items()},
            digits=3,
        ),
        (
            f"Nothing pruned: {one[figure]:.3f} dB with one range, {default[figure]:.3f} dB with one for 512 rows "
            f"({_share(default, one, figure)} of it, {_share(default, one, 'error')} of the squared error; "
            f"{default['extra_bytes']} bytes more), {paper[figure]:.3f} dB with {PAPER_GROUPS} "
            f"({_share(paper, one, figure)}, {_share(paper, one, 'error')}; {paper['extra_bytes']} bytes more).",
        ),
    )


def _scientific(value: float) -> float:
    """The value rounded to four significant digits."""
    return float(f"{value:.4g}")


def _short(loss: float) -> str:
    """The loss with two digits, or three if it would look like zero; never a negative zero."""
    return f"{round(loss, 3 if abs(loss) < 0.1 else 2) + 0.0:g}"


def _share(row: dict[str, Cell], other: dict[str, Cell], column: str) -> str:
    part, whole = row[column], other[column]
    assert isinstance(part, float) and isinstance(whole, float)
    return f"{100 * part / whole:.0f} %" if whole > 0 else "no share"


def _mb(row: dict[str, Cell]) -> str:
    assert isinstance(row["size"], int)
    return f"{row['size'] / 1e6:.2f} MB"
