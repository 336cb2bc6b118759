"""Charts of experiments: records of what to draw, and the functions that draw them with matplotlib.

matplotlib is an extra, so we import it only inside functions. Colours are those of Okabe and Ito, which colour-blind readers
can tell apart. Each series also has its own mark.
"""

from __future__ import annotations

import io
import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

from flexgs_edge.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 144
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#A0A000")
INK = "#222222"
SHORT = 8  # Notes shorter than this many letters are centred over their point
MARKS = ("o", "s", "^", "D", "v", "P", "<", ">")
LINEAR_BELOW = 0.1
LEVELS = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0)
_STYLE: dict[Any, Any] = {
    "font.size": 9.0,
    "axes.titlesize": 10.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e3e3e3",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "figure.facecolor": "white",
    # Ids in SVG files derive from this word and not from chance, so that equal charts have equal bytes.
    "svg.hashsalt": "flexgs-edge",
    # Text becomes outlines, so that a chart looks the same without its fonts.
    "svg.fonttype": "path",
}


@dataclass(frozen=True)
class Series:
    """Points of one kind. Points whose y is None are left out. `x`, `y`: coordinates of the points."""

    label: str  # name in the legend
    x: Sequence[float]
    y: Sequence[float | None]
    line: bool = True  # join the points by a line
    notes: Sequence[str] = ()  # text beside each point
    # x of points to cross out, where quality counts as broken. Points without a y are crossed out at the top of the chart.
    broken: Sequence[float] = ()


@dataclass(frozen=True)
class Chart(ABC):
    """What to draw."""

    title: str
    inches: ClassVar[tuple[float, float]] = (7.2, 4.4)

    @abstractmethod
    def draw(self, axes: Axes) -> None:
        """Draw it with matplotlib, without its title."""


@dataclass(frozen=True)
class LineChart(Chart):
    """Curves over a common axis."""

    x_label: str
    y_label: str
    series: tuple[Series, ...]
    limit: float | None = None  # mark this y with a line, such as a target
    doublings: bool = False  # show x in powers of two
    # Show y on a log scale that is linear below `LINEAR_BELOW`, for losses below and far above 1 dB in one chart.
    magnitudes: bool = False
    floating: bool = False  # y need not start at zero, such as for fidelity
    log_x: bool = False  # a plain log scale, such as for times and bytes: all values must be above zero
    # Pareto front: points that no other point beats, joined by steps under the series.
    front: Sequence[tuple[float, float]] = ()

    def draw(self, axes: Axes) -> None:
        from matplotlib.patheffects import withStroke
        from matplotlib.ticker import LogLocator, NullLocator

        xs = [x for series in self.series for x in series.x]
        scale = math.log2 if self.doublings or self.log_x else float
        middle = (scale(min(xs)) + scale(max(xs))) / 2
        for place, series in enumerate(self.series):
            colour, mark = COLOURS[place], MARKS[place]
            points = [(x, y, i) for i, (x, y) in enumerate(zip(series.x, series.y)) if y is not None]
            axes.plot(
                [x for x, _, _ in points],
                [y for _, y, _ in points],
                linestyle="-" if series.line else "",
                linewidth=1.5,
                label=series.label,
                color=colour,
                marker=mark,
                markersize=5,
                zorder=3,
                clip_on=False,  # show marks at zero whole
            )
            for broken in series.broken:
                _cross(axes, broken, next((y for x, y, _ in points if x == broken), None), colour)
            for x, y, i in points:
                if series.notes:
                    words = series.notes[i]
                    # Long notes extend towards the middle, so that they stay inside the chart. All have a white outline.
                    side = "center" if len(words) < SHORT else "right" if scale(x) > middle else "left"
                    note = axes.annotate(
                        words, (x, y), (0, 6), textcoords="offset points", fontsize=8, ha=side, zorder=5
                    )
                    note.set_path_effects([withStroke(linewidth=2.5, foreground="white")])
        if self.limit is not None:
            axes.axhline(self.limit, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
            axes.annotate(
                f"{self.limit:g} dB", (1, self.limit), (-2, 2), ("axes fraction", "data"), "offset points", ha="right"
            )
        if self.doublings:
            axes.set_xscale("log", base=2)
            axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}x")
        if self.log_x:
            axes.set_xscale("log")
            axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axes.xaxis.set_major_formatter(lambda x, _: f"{x:g}")
            axes.xaxis.set_minor_locator(NullLocator())
        if self.front:
            steps: dict[str, Any] = {"color": INK, "linewidth": 1.0, "linestyle": (0, (2, 2)), "zorder": 1}
            axes.step(*coordinates(sorted(self.front)), where="post", label="Pareto front", **steps)
        # Axes of losses start at zero, or below if compression helped, so that small losses do not look large.
        shown = [y for series in self.series for y in series.y if y is not None]
        low, high = min(shown, default=0.0), max(shown, default=1.0)
        if self.limit is not None:
            high = max(high, self.limit)  # a mark outside the axes would shrink them
        if self.magnitudes:
            axes.set_yscale("symlog", linthresh=LINEAR_BELOW, linscale=0.4)
            axes.set_yticks((0.0, *LEVELS), [f"{level:g}" for level in (0.0, *LEVELS)], minor=False)
            axes.yaxis.set_minor_locator(NullLocator())
        if not self.floating:
            axes.set_ylim(min(low * 1.1, 0.0), max(high, LINEAR_BELOW) * (1.4 if self.magnitudes else 1.1))
        axes.set_xlabel(self.x_label)
        axes.set_ylabel(self.y_label + (", log above 0.1" if self.magnitudes else ""))
        if any(series.label for series in self.series):
            axes.legend()


@dataclass(frozen=True)
class BarChart(Chart):
    """Grouped bars from zero, each with its value."""

    y_label: str
    groups: Sequence[str]  # along the axis
    bars: dict[str, Sequence[float | None]]  # one value per group, by label
    digits: int = 2
    limit: float | None = None  # mark this level with a line, and bars above it with a cross

    def draw(self, axes: Axes) -> None:
        width = 0.8 / len(self.bars)
        for number, (label, values) in enumerate(self.bars.items()):
            left = [group - 0.4 + (number + 0.5) * width for group in range(len(self.groups))]
            shown = [value or 0.0 for value in values]
            bars = axes.bar(left, shown, width * 0.94, color=COLOURS[number], label=label)
            axes.bar_label(bars, [_bar_words(value, self) for value in values], padding=2, fontsize=7.5, color=INK)
        axes.axhline(0.0, color=INK, linewidth=0.8)
        if self.limit is not None:
            axes.axhline(self.limit, color=INK, linewidth=0.8, linestyle=(0, (4, 3)))
        axes.set_xticks(range(len(self.groups)), self.groups)
        axes.grid(axis="x", visible=False)
        axes.margins(y=0.12)
        axes.set_ylabel(self.y_label)
        if len(self.bars) > 1:
            axes.legend()


def require_matplotlib() -> None:
    """Import matplotlib, or raise `InputError` that says how to install it. Call this before any work starts."""
    try:
        import matplotlib.figure  # noqa: F401
    except ImportError as error:
        raise InputError(
            f"charts need matplotlib, which cannot be loaded here ({error}): pip install 'flexgs-edge[charts]'"
        ) from error


def picture(chart: Chart) -> tuple[bytes, bytes]:
    """Draw the chart as PNG and as SVG. The same chart gives the same bytes on the same machine."""
    import matplotlib

    png, svg = io.BytesIO(), io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        figure = draw(chart)
        figure.savefig(png, format="png", dpi=DPI, metadata={"Software": None})
        figure.savefig(svg, format="svg", metadata={"Date": None, "Creator": None})
    return png.getvalue(), svg.getvalue()


def draw(chart: Chart) -> Figure:
    """Draw the chart as a matplotlib figure, without pyplot: no windows and no global state."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=chart.inches, layout="constrained")
    axes = figure.add_subplot()
    axes.set_title(chart.title, loc="left")
    chart.draw(axes)
    return figure


def _cross(axes: Axes, x: float, y: float | None, colour: str) -> None:
    cross: dict[str, Any] = {"color": colour, "markersize": 13, "markeredgewidth": 2.2, "clip_on": False, "zorder": 6}
    if y is None:
        axes.plot([x], [0.98], "x", transform=axes.get_xaxis_transform(), **cross)
    else:
        axes.plot([x], [y], "x", **cross)


def _bar_words(value: float | None, chart: BarChart) -> str:
    if value is None:
        return "-"
    beyond = chart.limit is not None and value > chart.limit
    return ("\N{MULTIPLICATION SIGN}\n" if beyond else "") + f"{value:.{chart.digits}f}"


def coordinates(points: Sequence[tuple[float, float]]) -> tuple[list[float], list[float]]:
    """The x and the y of some points."""
    return [x for x, _ in points], [y for _, y in points]
