"""Drawings of a report: the chart of a search, plans of cameras, and error maps."""

from __future__ import annotations

import re

import numpy as np
import pytest

from flexgs_edge.goals.steps import Choice, Step
from flexgs_edge.goals.target import MaxDrop, Measurement
from flexgs_edge.report.material import ERROR_SCALE, Rig, error_map, ramp
from flexgs_edge.report.pages import nice_range, plans, step_chart
from page_parser import Page


def test_chart_needs_two_steps_and_holds_any_numbers() -> None:
    step = Step(Choice(0, 0), 100, Measurement(None, None, 0.0), 0.0, "list", 0.1)
    assert step_chart([step], step, MaxDrop(1.0, "modelled drop")) == ""
    assert "circle" in step_chart([step, step], step, MaxDrop(1.0, "modelled drop"))
    for values in ([0.0], [5.0, 5.0], [-3.0, 1e9], [1e-9, 2e-9]):
        low, high, ticks = nice_range(values)
        assert low < min(values) and max(values) < high
        assert ticks == sorted(set(ticks)) and low <= ticks[0] and ticks[-1] <= high and 1 <= len(ticks) <= 7


def test_plans_keep_the_places_and_the_sense_of_rotation() -> None:
    # Eight cameras on a circle around z, 1 above the middle, each looking inwards; the scene at the origin.
    turns = np.arange(8) * np.pi / 4
    centers = np.stack([2 * np.cos(turns), 2 * np.sin(turns), np.ones(8)], axis=1)
    forward = -centers / np.linalg.norm(centers, axis=1)[:, None]
    right = np.stack([np.cross(f, (0, 0, 1)) / np.linalg.norm(np.cross(f, (0, 0, 1))) for f in forward])
    rotations = np.stack([right, np.cross(forward, right), forward], axis=1)
    names = tuple(f"v{i}" for i in range(8))
    rig = Rig(names, centers, rotations, np.full((8, 2), 0.5), frozenset({0}), np.zeros((5, 3)))
    page = Page(plans(rig, {"v3": 1}))
    stands = page.named("circle", "stand")
    assert len([s for s in stands if "held" in s["class"]]) == 3, "one in each plan and in the key"
    # Held-out ones are drawn last.
    top, side = (np.array([(float(s["cx"]), float(s["cy"])) for s in stands[i : i + 8]]) for i in (0, 8))
    order = [*range(1, 8), 0]
    flat = top - top.mean(axis=0)
    radius = np.linalg.norm(flat, axis=1)
    assert np.ptp(radius) < 0.5 and radius.mean() > 100
    angles = np.unwrap(np.arctan2(-flat[:, 1], flat[:, 0])[np.argsort(order)])
    assert np.allclose(np.diff(angles), np.pi / 4, atol=0.02), "from above x to y turns left, as on paper"
    assert np.ptp(side[:, 1]) < 0.2, "all at one height"
    dots = [float(number) for number in re.findall(r"[\d.]+", page.named("path", "points")[1]["d"])]
    assert dots[1] - side[0, 1] == pytest.approx(radius.mean() / 2, abs=2), "the scene is 1 below, on the same scale"


@pytest.mark.parametrize("count", [1, 2])
def test_plans_of_few_cameras_in_one_place(count: int) -> None:
    turned = np.diag([1.0, -1.0, -1.0])
    rig = Rig(
        ("a", "b")[:count], np.zeros((count, 3)), np.stack([np.eye(3), turned])[:count], np.ones((count, 2)),
        frozenset(), np.zeros((0, 3)),
    )  # fmt: skip
    page = Page(plans(rig, {}))
    assert "nan" not in str(page.tags) and len(page.named("circle", "stand")) == 2 * count


def test_error_maps_have_a_fixed_scale_that_gets_brighter() -> None:
    image, reference = np.zeros((1, 3, 3), np.float32), np.zeros((1, 3, 3), np.float32)
    image[0, 1] = (0.2 * ERROR_SCALE, 0.5 * ERROR_SCALE, 0)
    image[0, 2] = 7.0  # clamped like every picture, and off the scale
    assert error_map(image, reference) == pytest.approx(np.array([[0.0, 0.5, 1.0]]))
    brightness = ramp() @ np.array([0.2126, 0.7152, 0.0722])
    assert ramp().shape == (256, 3) and np.all(np.diff(brightness) >= 0) and brightness[-1] - brightness[0] > 200
