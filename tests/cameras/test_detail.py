"""How fine Gaussians are among others, which are drawn, and sums over directions."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexgs_edge.cameras.detail import CRUMB_ROWS, UNITS, WIDEST, few_rows, smears, things
from flexgs_edge.cameras.directions import Frames, bins_of, fibonacci, filled_share
from flexgs_edge.cameras.scene_sample import DRAWN_ROWS, find_parts, sample_scene
from synthetic import make_splats


def ball(count: int = 3000, radius: float = 1.0) -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points * radius * np.linspace(0, 1, count)[:, None] ** (1 / 3) / np.linalg.norm(points, axis=1)[:, None]


def test_what_is_wider_than_those_around_it_is_smeared() -> None:
    """A fine ball, a coarse one far away, and a wide splat in each: only the one among fine ones is out of place."""
    means = np.concatenate([ball(), ball(300) * 10 + [[200, 0, 0]], [[0, 0, 0.5]], [[200, 0, 5]]]).T
    sizes = np.concatenate([np.full(3000, 0.02), np.full(300, 1.0), [1.0], [1.0]])
    logs, place = smears(means, sizes, np.array([-300.0] * 3), 600.0)
    assert sorted(place) == list(range(sizes.size))
    assert (
        np.quantile(np.abs(logs[:3000]), 0.99) < 0.1 * UNITS
        and logs[-2] == WIDEST * UNITS
        and abs(logs[-1]) < 0.1 * UNITS
    )
    # Neither the place nor the unit matter.
    moved, _ = smears(means * 1e3 + 5e3, sizes * 1e3, np.array([-295e3] * 3), 600e3)
    np.testing.assert_allclose(moved[[0, -2, -1]], logs[[0, -2, -1]], atol=0.1 * UNITS)


def test_what_touches_nothing_of_its_size_is_a_thing() -> None:
    """A ball, one of its size apart from it, and a fine one right in it: three things, and a few crumbs."""
    means = np.concatenate(
        [ball(), ball(500) + np.array([4, 0, 0]), ball(400) * 0.05 + [[0, 1.0, 0]], ball(20) * 0.1 + [[0, 9, 0]]]
    ).T
    sizes = np.concatenate([np.full(3000, 0.1), np.full(500, 0.1), np.full(400, 0.005), np.full(20, 0.1)])
    found = things(means, sizes, np.zeros(3))
    assert (found == np.repeat([0, 1, 2, -1], [3000, 500, 400, 20])).all()
    # Neither the order, the unit nor the place matter.
    order = np.random.default_rng(0).permutation(sizes.size)
    assert (things(means[:, order], sizes[order], np.zeros(3)) == found[order]).all()
    assert (things(means * 1024 - 7e4, sizes * 1024, np.array([3e5, 0.0, 1.0])) == found).all()
    # Sizes that follow each other hold the fine ball and the coarse one together.
    chain = np.geomspace(0.005, 0.1, 60)
    joined = np.concatenate([means, np.stack([0 * chain, np.linspace(1.0, 0.9, 60), 0 * chain])], axis=1)
    assert (things(joined, np.concatenate([sizes, chain]), np.zeros(3))[3500:3900] == 0).all()


def test_a_long_row_is_one_thing_and_single_ones_are_none() -> None:
    along = np.stack([np.arange(5000.0), np.zeros(5000), np.zeros(5000)])
    row = np.random.default_rng(0).permutation(5000)
    assert (things(along[:, row], np.full(5000, 0.3), np.zeros(3)) == 0).all()
    assert (things(along[:, row], np.full(5000, 0.03), np.zeros(3)) == -1).all()
    assert (things(along[:, :CRUMB_ROWS], np.full(CRUMB_ROWS, 0.3), np.zeros(3)) == 0).all()
    # The ends of float32 do not fail.
    assert things(np.array([[3e38, -3e38, 0.0]] * 3), np.array([1e-17, 1e17, 1.0]), np.zeros(3)).tolist() == [-1] * 3


def test_few_rows_cover_as_much_as_all() -> None:
    areas = np.random.default_rng(0).lognormal(0, 2, 20000)
    rows, growth = few_rows(areas, 1000)
    assert 900 <= rows.size <= 1100 and (np.diff(rows) > 0).all()
    assert (areas[rows] * growth**2).sum() == pytest.approx(areas.sum(), rel=0.05)
    assert np.isin(np.argsort(areas)[-100:], rows).all() and growth[np.argmax(areas[rows])] == 1
    rows, growth = few_rows(areas[:500], 1000)
    assert rows.size == 500 and (growth == 1).all()


def test_a_large_scene_is_drawn_in_few_rows() -> None:
    count = 3 * DRAWN_ROWS
    scene = sample_scene(make_splats(ball(count), np.full((count, 3), 0.02)))
    np.testing.assert_allclose(scene.whole.middle, 0, atol=0.1)
    assert scene.planes["means"].shape[1] == scene.sizes.size <= DRAWN_ROWS
    assert scene.stands.sum() == pytest.approx(count, rel=0.05)


def test_sides_with_matter() -> None:
    lines = fibonacci(20000).T
    assert filled_share(bins_of(lines)) == 1
    assert 0.5 <= filled_share(bins_of(lines[:, lines[2] > 0])) < 0.6


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
