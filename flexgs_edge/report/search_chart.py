"""The chart of a search's steps, as inline SVG."""

from __future__ import annotations

import math
from collections.abc import Sequence

from flexgs_edge.goals.steps import Step
from flexgs_edge.goals.target import Target
from flexgs_edge.report.html import render

# As wide as a phone, so that text stays readable there. On larger screens the chart and its text grow together.
WIDTH, HEIGHT = 360, 230
_LEFT, _RIGHT, _TOP, _BOTTOM = 44, WIDTH - 12, 14, HEIGHT - 38


def step_chart(steps: Sequence[Step], chosen: Step, target: Target) -> str:
    """Draw file size against the deciding figure, with one mark per step.

    Returns an empty string if fewer than two steps can be shown. Steps with identical renders have no place on a scale in dB.
    """
    judge = target.figure
    # Find the chosen step by identity: other steps may have equal figures.
    points = [(s.size, at, s) for s in steps if s.measurement and (at := s.measurement.figure(judge)) is not None]
    if len(points) < 2:
        return ""
    limit = getattr(target, "limit", None) if target.limit_bytes is None else None
    low_x, high_x, ticks_x = nice_range([p[0] for p in points] + ([target.limit_bytes] if target.limit_bytes else []))
    low_y, high_y, ticks_y = nice_range([p[1] for p in points] + ([limit] if limit is not None else []))
    unit, word = _unit(high_x)

    def x(value: float) -> float:
        return _LEFT + (value - low_x) / (high_x - low_x) * (_RIGHT - _LEFT)

    def y(value: float) -> float:
        return _BOTTOM - (value - low_y) / (high_y - low_y) * (_BOTTOM - _TOP)

    return render(
        "step_chart.svg",
        width=WIDTH,
        height=HEIGHT,
        left=_LEFT,
        right=_RIGHT,
        top=_TOP,
        bottom=_BOTTOM,
        judge=judge,
        target=target,
        chosen=chosen,
        unit=word,
        ticks_x=[(tick / unit, x(tick)) for tick in ticks_x],
        ticks_y=[(tick, y(tick)) for tick in ticks_y],
        limit_x=None if target.limit_bytes is None else x(target.limit_bytes),
        limit_y=None if limit is None else y(limit),
        marks=[(x(size), y(at), step) for size, at, step in points],
    )


def _unit(most: float) -> tuple[int, str]:
    for scale, word in ((10**9, "GB"), (10**6, "MB"), (10**3, "kB")):
        if most >= scale:
            return scale, word
    return 1, "bytes"


def nice_range(values: Sequence[float], most: int = 5) -> tuple[float, float, list[float]]:
    """Choose the ends of an axis with a margin around all values, and at most `most` + 1 round ticks.

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
