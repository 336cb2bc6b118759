"""The chart of a search's steps, and bars beside numbers, as inline SVG and CSS."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Measurement, Target
from flexgs_edge.report.html import Markup, text
from flexgs_edge.units import format_size

# As wide as a phone: on larger screens the chart grows, and its words with it, instead of becoming unreadable on small ones.
WIDTH, HEIGHT = 360, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, 12, 14, 38

STYLE = """
.chart { display: block; width: 100%; max-width: 34rem; font-size: 11px; }
.chart text { fill: var(--soft); } .chart .grid { stroke: var(--line); }
.chart .way { fill: none; stroke: var(--soft); opacity: .45; }
.chart .step { fill: var(--paper); stroke: var(--mark); stroke-width: 1.5; } .chart .holds { fill: var(--mark); }
.chart .chosen { fill: none; stroke: var(--ink); stroke-width: 2; }
.chart .target { stroke: var(--warm); stroke-width: 1.5; stroke-dasharray: 5 3; }
.chart text.target-word { fill: var(--warm); }
.key { color: var(--soft); font-size: .9rem; }
.key svg { display: inline-block; width: 1rem; height: 1rem; background: none; vertical-align: -.15em; }
.bars td:first-child { white-space: normal; overflow-wrap: normal; } td.bar { width: 16vw; min-width: 16vw; padding-right: 0;
  text-align: left; }
td.bar span { display: block; height: .7rem; min-width: 1px; background: var(--mark); border-radius: 2px; }
"""


def step_chart(steps: Sequence[Step], chosen: Step, target: Target) -> str:
    """Size against the figure that judges, a mark a step; empty with fewer than two steps that were measured."""
    judge = target.figure
    # The chosen step may be equal to others in all its figures: it is found by identity.
    points = [(s.size, figure, s) for s in steps if (figure := _figure(s.measurement, target)) is not None]
    if len(points) < 2:
        return ""
    limit = getattr(target, "limit", None) if target.limit_bytes is None else None
    low_x, high_x, ticks_x = nice_range([p[0] for p in points] + ([target.limit_bytes] if target.limit_bytes else []))
    low_y, high_y, ticks_y = nice_range([p[1] for p in points] + ([limit] if limit is not None else []))

    def x(value: float) -> float:
        return _LEFT + (value - low_x) / (high_x - low_x) * (WIDTH - _LEFT - _RIGHT)

    def y(value: float) -> float:
        return HEIGHT - _BOTTOM - (value - low_y) / (high_y - low_y) * (HEIGHT - _TOP - _BOTTOM)

    words = f"Size and {judge} of {len(points)} steps of the search"
    parts = [f'<svg class="chart" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{text(words)}">']
    for tick in ticks_y:
        parts.append(f'<path class="grid" d="M{_LEFT} {y(tick):.1f}H{WIDTH - _RIGHT}"/>')
        parts.append(f'<text x="{_LEFT - 5}" y="{y(tick) + 4:.1f}" text-anchor="end">{tick:g}</text>')
    unit, word = _unit(high_x)
    for tick in ticks_x:
        parts.append(f'<path class="grid" d="M{x(tick):.1f} {HEIGHT - _BOTTOM}v4"/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{HEIGHT - _BOTTOM + 15}" text-anchor="middle">{tick / unit:g}</text>')
    parts.append(f'<text x="{WIDTH - _RIGHT}" y="{HEIGHT - 6}" text-anchor="end">size, {word}</text>')
    parts.append(f'<text x="4" y="{_TOP - 4}">{text(judge)}, dB</text>')
    parts.append(_target_line(target, limit, x, y))
    way = " ".join(f"{x(size):.1f},{y(figure):.1f}" for size, figure, _ in points)
    parts.append(f'<polyline class="way" points="{way}"/>')
    for size, figure, step in points:
        at = f'cx="{x(size):.1f}" cy="{y(figure):.1f}"'
        parts.append(
            f'<circle class="step{" holds" if step.holds else ""}" {at} r="3.5"><title>{_step_words(step)}</title></circle>'
        )
        if step is chosen:
            parts.append(f'<circle class="chosen" {at} r="7"/>')
    return "\n".join([*parts, "</svg>", _KEY])


def _key(mark: str, words: str) -> str:
    return f'<svg class="chart" viewBox="0 0 16 16" aria-hidden="true">{mark}</svg> {words}'


_KEY = "&ensp; ".join(
    (
        '<p class="key">' + _key('<circle class="step holds" cx="8" cy="8" r="4"/>', "holds the target"),
        _key('<circle class="step" cx="8" cy="8" r="4"/>', "misses it"),
        _key('<circle class="chosen" cx="8" cy="8" r="6"/>', "chosen"),
        _key('<path class="target" d="M0 8h16"/>', "target") + "</p>",
    )
)


def _figure(measurement: Measurement | None, target: Target) -> float | None:
    """`None` for identical renders too: they have no place on a scale in dB."""
    return None if measurement is None else measurement.figure(target.figure)


def _target_line(target: Target, limit: float | None, x: object, y: object) -> str:
    assert callable(x) and callable(y)
    if target.limit_bytes is not None:
        at = x(target.limit_bytes)
        end = "end" if at > WIDTH / 2 else "start"
        return (
            f'<path class="target" d="M{at:.1f} {_TOP}V{HEIGHT - _BOTTOM}"/>'
            f'<text class="target-word" x="{at + (-5 if end == "end" else 5):.1f}" y="{_TOP + 10}" text-anchor="{end}">'
            f"{text(format_size(target.limit_bytes))}</text>"
        )
    if limit is None:
        return ""
    word = f'<text class="target-word" x="{WIDTH - _RIGHT}" y="{y(limit) - 5:.1f}" text-anchor="end">'
    return f'<path class="target" d="M{_LEFT} {y(limit):.1f}H{WIDTH - _RIGHT}"/>{word}{text(target.describe())}</text>'


def _step_words(step: Step) -> str:
    found = step.measurement
    figures = "" if found is None else f", modelled drop {found.modelled_drop:.3f} dB"
    if found is not None and found.drop is not None:
        figures = f", drop {found.drop:.3f} dB"
    rates = f"prune {step.choice.prune / 1000:g}, SH {step.choice.sh / 1000:g}"
    figures += " (estimated)" if step.estimated else ""
    return text(f"{step.phase}: {rates}: {format_size(step.size)}{figures}")


def _unit(most: float) -> tuple[int, str]:
    for scale, word in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if most >= scale:
            return scale, word
    return 1, "bytes"


def nice_range(values: Sequence[float], most: int = 5) -> tuple[float, float, list[float]]:
    """Ends of an axis that holds all values with some room, and at most `most` + 1 round ticks within.

    >>> nice_range([0.0, 1.0])
    (-0.08, 1.08, [0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    """
    low, high = min(values), max(values)
    span = high - low or abs(high) or 1.0
    low, high = low - 0.08 * span, high + 0.08 * span
    raw = (high - low) / (most + 1)
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= raw * (1 - 1e-9))
    first, last = math.ceil(low / step), math.floor(high / step)
    return low, high, [round(index * step, 12) for index in range(first, last + 1)]


def bar(share: float) -> Markup:
    """A cell that shows a share from 0 to 1; `bar_table` puts it in its column."""
    return Markup(f'<span style="width:{100 * min(max(share, 0.0), 1.0):.2f}%"></span>')


def bar_table(heads: Sequence[str], rows: Iterable[tuple[str, float, Sequence[object]]], label: str) -> str:
    """Rows of (name, value, cells): a bar a row, the longest as wide as its column."""
    rows = list(rows)
    most = max((value for _, value, _ in rows), default=0.0) or 1.0
    head = "".join(f'<th scope="col">{text(cell)}</th>' for cell in (heads[0], "", *heads[1:]))
    body = "\n".join(
        f'<tr><td>{text(name)}</td><td class="bar">{bar(value / most)}</td>'
        + "".join(f"<td>{text(cell)}</td>" for cell in cells)
        + "</tr>"
        for name, value, cells in rows
    )
    return (
        f'<div class="scroll bars" tabindex="0" role="region" aria-label="{text(label)}"><table>\n'
        f"<thead><tr>{head}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table></div>"
    )
