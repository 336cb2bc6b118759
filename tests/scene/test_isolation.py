"""How isolated Gaussians are: what lies alone and is small beside its distance, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.scene import isolation as module
from flexgs_edge.scene.isolation import BLOCK, NEIGHBOUR, isolation, usual_deviation

FAR = np.array([[9.0, -8, 7, 60, -3], [8.0, 9, -6, 40, 9], [-7.0, 6, 9, -50, 2]])


def cloud(count: int, scale: float = -3.0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(5)
    return rng.uniform(-1, 1, (3, count)), rng.normal(scale, 0.3, (3, count))


def with_far(count: int, scale: float) -> np.ndarray:
    means, scales = cloud(count)
    return isolation(np.hstack([means, FAR]), np.hstack([scales, np.full((3, FAR.shape[1]), scale)]))


def test_small_ones_far_out_are_isolated() -> None:
    found = with_far(3000, -3.0)
    assert found[3000:].min() > 6.0 > np.quantile(found[:3000], 0.999)


def test_large_ones_are_less_isolated_at_the_same_places() -> None:
    assert np.all(with_far(3000, 2.5)[3000:] < with_far(3000, -3.0)[3000:] - 5)


def test_distances_are_those_of_the_fourth_neighbour() -> None:
    """Exactly for most, more for a few, never less."""
    means, _ = cloud(800)
    found = module._neighbour_distances(means)
    exact = np.sort(np.linalg.norm(means[:, :, None] - means[:, None], axis=0), axis=0)[NEIGHBOUR]
    assert np.mean(np.isclose(found, exact)) > 0.5
    assert np.all(found >= exact * (1 - 1e-12)) and np.all(found < 2 * exact)


def test_blocks_do_not_show(monkeypatch: pytest.MonkeyPatch) -> None:
    means, scales = cloud(500)
    whole = isolation(means, scales)
    monkeypatch.setattr(module, "BLOCK", 37)
    assert BLOCK > 500 and np.array_equal(isolation(means, scales), whole)


def test_few_and_equal_ones_are_not_isolated() -> None:
    for means in (np.zeros((3, 0)), np.eye(3), np.zeros((3, 50)), np.arange(15.0).reshape(3, 5)):
        found = isolation(means, np.zeros(means.shape))
        assert found.shape == means.shape[1:] and np.all(np.abs(found) < 6.0)
    assert usual_deviation(np.zeros(0)) == 0.0
