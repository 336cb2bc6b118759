"""Charts of the paper's experiments alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar

from flexgs_edge.report.plots import COLOURS, INK, MARKS, Chart, coordinates

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class DotChart(Chart):
    """Grouped dots on a log axis with text beside them, for values of many magnitudes."""

    y_label: str
    groups: Sequence[str]  # along the axis
    # One value per group, by label. Values of zero or below stand at the bottom as "none". None is left out.
    dots: dict[str, Sequence[float | None]]
    words: dict[str, Sequence[str]]  # text beside each dot, arranged as `dots`

    def draw(self, axes: Axes) -> None:
        axes.set_yscale("log")
        shown = [value for values in self.dots.values() for value in values if value is not None and value > 0]
        axes.set_ylim(min(shown, default=1.0) / 4, max(shown, default=1.0) * 4)
        foot = axes.get_ylim()[0]
        width = 0.5 / len(self.dots)
        for number, (label, values) in enumerate(self.dots.items()):
            x = [group + (number + 0.5) * width - 0.4 for group in range(len(self.groups))]
            points = [(at, value) for at, value in zip(x, values) if value is not None and value > 0]
            axes.plot(*coordinates(points), MARKS[number], color=COLOURS[number], markersize=7, label=label)
            for at, value, words in zip(x, values, self.words[label]):
                if value is None:
                    continue
                place = (at, value) if value > 0 else (at, foot)
                text = words if value > 0 else f"none: {words}"
                axes.annotate(text, place, (6, 0), textcoords="offset points", va="center", fontsize=8)
        axes.set_xticks(range(len(self.groups)), self.groups)
        axes.set_xlim(-0.6, len(self.groups) - 0.4)
        axes.set_ylabel(self.y_label)
        axes.legend()


@dataclass(frozen=True)
class PlaneChart(Chart):
    """A grid of cells over the prune rate and the SH rate, with lines and points on it."""

    inches: ClassVar[tuple[float, float]] = (7.2, 6.2)
    x_label: str
    y_label: str
    colour_label: str
    cells: dict[tuple[float, float], float]  # value of each cell, by its centre (x, y)
    step: float  # side of a cell
    top: float  # values from here up share the last colour
    frontier: Sequence[tuple[float, float]]  # line on which the limit is reached
    frontier_label: str
    marked: Sequence[tuple[float, float]]  # cells to mark with a dot: the paper's candidates
    # Points that a search visited, in order. The last one is its result.
    path: Sequence[tuple[float, float]] = field(default=())
    answer: tuple[float, float] | None = None

    def draw(self, axes: Axes) -> None:
        from matplotlib import colormaps
        from matplotlib.colors import Normalize
        from matplotlib.patches import Rectangle

        colours, scale = colormaps["cividis_r"], Normalize(0.0, self.top)
        half = self.step / 2
        for (x, y), value in self.cells.items():
            colour = colours(scale(value))
            axes.add_patch(Rectangle((x - half, y - half), self.step, self.step, facecolor=colour, edgecolor="white"))
            dark = sum(colour[:3]) < 1.5
            axes.annotate(
                f"{value:.2f}",
                (x, y - half * 0.75),
                ha="center",
                fontsize=6.5,
                color="white" if dark else INK,
                zorder=4,
            )
        axes.plot(
            *coordinates(self.marked), "o", color="white", markeredgecolor=INK, markersize=5, label="paper's candidates"
        )
        axes.plot(*coordinates(self.frontier), "-", color=INK, linewidth=2.2, label=self.frontier_label)
        axes.plot(
            *coordinates(self.path), "-", color=COLOURS[1], linewidth=1.0, marker=".", markersize=5, label="search"
        )
        if self.answer is not None:
            axes.plot(*self.answer, "*", color=COLOURS[1], markeredgecolor="white", markersize=14, label="its answer")
        xs, ys = [x for x, _ in self.cells], [y for _, y in self.cells]
        axes.set_xlim(min(xs) - half, max(xs) + half)
        axes.set_ylim(min(ys) - half, max(ys) + half)
        axes.set_aspect("equal")
        axes.grid(visible=False)
        axes.set_xlabel(self.x_label)
        axes.set_ylabel(self.y_label)
        axes.legend(loc="upper right")
        from matplotlib.cm import ScalarMappable

        axes.figure.colorbar(
            ScalarMappable(scale, colours), ax=axes, label=self.colour_label, extend="max", shrink=0.85
        )
