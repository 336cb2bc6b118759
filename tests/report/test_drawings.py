"""Drawings of a report: the chart of a search and error maps."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.goals.steps import Choice, Step
from flexgs_edge.goals.target import MaxDrop, Measurement
from flexgs_edge.report.pages import ERROR_SCALE, error_map, nice_range, ramp, step_chart


def test_chart_needs_two_steps_and_holds_any_numbers() -> None:
    step = Step(Choice(0, 0), 100, Measurement(None, None, 0.0), 0.0, "list", 0.1)
    assert step_chart([step], step, MaxDrop(1.0, "modelled drop")) == ""
    assert "circle" in step_chart([step, step], step, MaxDrop(1.0, "modelled drop"))
    for values in ([0.0], [5.0, 5.0], [-3.0, 1e9], [1e-9, 2e-9]):
        low, high, ticks = nice_range(values)
        assert low < min(values) and max(values) < high
        assert ticks == sorted(set(ticks)) and low <= ticks[0] and ticks[-1] <= high and 1 <= len(ticks) <= 7


def test_error_maps_have_a_fixed_scale_that_gets_brighter() -> None:
    image, reference = np.zeros((1, 3, 3), np.float32), np.zeros((1, 3, 3), np.float32)
    image[0, 1] = (0.2 * ERROR_SCALE, 0.5 * ERROR_SCALE, 0)
    image[0, 2] = 7.0  # clamped like every picture, and off the scale
    assert error_map(image, reference) == pytest.approx(np.array([[0.0, 0.5, 1.0]]))
    brightness = ramp() @ np.array([0.2126, 0.7152, 0.0722])
    assert ramp().shape == (256, 3) and np.all(np.diff(brightness) >= 0) and brightness[-1] - brightness[0] > 200
