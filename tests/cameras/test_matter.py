"""The grid of matter, and sums over directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexgs_edge.cameras.directions import Frames, bins_of, fibonacci
from flexgs_edge.cameras.matter import spread_matter
from flexgs_edge.cameras.witnesses import find_parts, gather_witnesses
from synthetic import make_splats


def ball(count: int = 3000, radius: float = 1.0) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points * radius * np.linspace(0, 1, count)[:, None] ** (1 / 3) / np.linalg.norm(points, axis=1)[:, None]


def test_the_grid_sees_matter() -> None:
    scene = gather_witnesses(make_splats(ball(), np.full((3000, 3), 0.08), opacity=0.95))
    np.testing.assert_allclose(scene.whole.middle, 0, atol=0.1)
    eyes, ends = np.array([[3.0], [0.0], [0.0]]), np.array([[-3.0, 3.0, 1.0], [0.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
    through, aside, surface = scene.matter.transmittance(eyes, ends, np.array([0.0, 0.0, 0.3]))[0]
    assert through < 0.2 and aside == 1.0 and surface > 0.8
    np.testing.assert_array_equal(scene.matter.optical_depth(np.array([[9.0, -9.0], [0.0, 0.0], [0.0, 0.0]])), 0)
    assert scene.matter.optical_depth(np.zeros((3, 1)))[0] > 0.25


def test_a_slab_takes_the_light_that_it_should() -> None:
    """Small splats spread evenly in a slab: light falls by their cross-sections over the area."""
    rng = np.random.default_rng(0)
    count, size = 20000, 0.01
    means = rng.uniform(-1, 1, (3, count)) * [[2], [2], [0.5]]
    axes = np.eye(3)[:, :, None] * size * np.ones(count)
    low, high = np.array([-2.0, -2.0, -0.5]), np.array([2.0, 2.0, 0.5])
    grid = spread_matter(means, axes, np.full(count, 0.7), (low, high), (np.zeros(3), 5.0))
    ends = np.stack([rng.uniform(-1, 1, 50), rng.uniform(-1, 1, 50), np.full(50, 3.0)])
    light = grid.transmittance(np.array([[0.0], [0.0], [-3.0]]), ends, np.zeros(50))[0]
    expected = 0.7 * 2 * math.pi * size * size * count / 16
    slant = np.linalg.norm(ends - [[0], [0], [-3]], axis=0) / 6
    np.testing.assert_allclose(-np.log(light) / slant, expected, rtol=0.3)
    assert np.mean(-np.log(light) / slant) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize("along", range(3))
def test_a_wide_splat_lies_along_its_axes(along: int) -> None:
    """A rod among faint small splats, of which the grid is made: its matter is where the rod is."""
    rng = np.random.default_rng(0)
    count = 20000
    means = np.concatenate([rng.uniform(-2, 2, (3, count)), np.zeros((3, 1))], axis=1)
    axes = np.eye(3)[:, :, None] * np.full(count + 1, 0.01)
    axes[:, :, -1] = np.eye(3) * 0.1
    axes[along, along, -1] = 1.0
    opacity = np.append(np.full(count, 1e-6), 0.9)
    grid = spread_matter(means, axes, opacity, (np.full(3, -2.0), np.full(3, 2.0)), (np.zeros(3), 5.0))
    places = np.linspace(0.5, 1.5, 50)
    found = [grid.optical_depth(sign * np.eye(3)[:, [axis]] * places).max() for axis in range(3) for sign in (1, -1)]
    assert [depth > 0.5 for depth in found] == [axis == along for axis in range(3) for _ in range(2)]


def test_cells_are_small_where_the_scene_is_dense() -> None:
    points = np.concatenate([ball(2000, 0.5), ball(1500, 40.0)])
    scene = gather_witnesses(make_splats(points, np.full((3500, 3), 0.02)))
    inner, outer = scene.matter.skin(np.array([[0.0, 25.0], [0.0, 25.0], [0.0, 25.0]]))
    assert outer > 8 * inner
    assert len(scene.parts) == 2 and scene.parts[1].extent < 1.5 and scene.whole.extent > 20


def test_other_ends_for_each_eye() -> None:
    scene = gather_witnesses(make_splats(ball(), np.full((3000, 3), 0.08)))
    eyes = np.random.default_rng(1).uniform(-3, 3, (3, 7))
    ends = np.random.default_rng(2).uniform(-3, 3, (3, 7, 5))
    together = scene.matter.transmittance(eyes, ends, np.full((7, 5), 0.1))
    for row in range(7):
        alone = scene.matter.transmittance(eyes[:, row : row + 1], ends[:, row], np.full(5, 0.1))
        np.testing.assert_array_equal(together[row], alone[0])


def test_a_cluster_far_apart_is_a_part_of_its_own() -> None:
    points = np.concatenate([ball(700), ball(300) + np.array([[500.0, 0, 0]])])
    parts = find_parts(points.T, np.full(1000, 0.05), np.ones(1000))
    assert len(parts) == 3
    assert sorted(round(part.middle[0] / 500) for part in parts[1:]) == [0, 1]
    assert max(part.extent for part in parts[1:]) < 3


def test_every_direction_has_a_bin_near_it() -> None:
    lines = fibonacci(5000).T
    frames = Frames(40, math.radians(25))
    own = bins_of(lines * np.linspace(1e-3, 1e3, 5000))
    np.testing.assert_array_equal(own, bins_of(lines))
    for row, direction in enumerate(frames.directions):
        inside = np.array([frames.sums(own[i : i + 1], np.ones(1))[row] for i in range(0, 5000, 50)])
        angle = np.degrees(np.arccos(np.clip(direction @ lines[:, ::50], -1, 1)))
        assert (inside[angle < 19] == 1).all() and (inside[angle > 31] == 0).all()


def test_sums_over_frames() -> None:
    rng = np.random.default_rng(0)
    lines, frames = rng.normal(size=(3, 4000)), Frames(60, math.radians(30))
    lines /= np.linalg.norm(lines, axis=0)
    found = frames.sums(bins_of(lines), np.ones(4000))
    exact = np.array([frames.holds(direction, lines).sum() for direction in frames.directions])
    np.testing.assert_allclose(found, exact, rtol=0.15)
    assert found.sum() == pytest.approx(exact.sum(), rel=0.02)
