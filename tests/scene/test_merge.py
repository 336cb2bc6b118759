"""Neighbours that become one Gaussian."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.memory.storage import IN_MEMORY
from flexgs_edge.scene.merge import MOST_OPACITY, merged
from flexgs_edge.scene.rotations import matrices
from flexgs_edge.scene.source import Planes, read_all
from synthetic import random_scene


def covariances(planes: Planes) -> np.ndarray:
    """[n, 3, 3] f64."""
    axes = matrices(planes["quats"]) * np.exp(planes["log_scales"].astype(np.float64)).T[:, None]
    return axes @ axes.transpose(0, 2, 1)


def scene(count: int) -> tuple[Planes, np.ndarray]:
    """Planes, and the weight of each row."""
    planes = read_all(random_scene(count, 5, 3), IN_MEMORY)
    longest = np.sort(np.exp(planes["log_scales"].astype(np.float64)), axis=0)[1:]
    return planes, longest.prod(axis=0) / (1 + np.exp(-planes["opacity_logits"][0].astype(np.float64)))


def test_each_group_keeps_its_moments() -> None:
    planes, light = scene(7)
    order = np.array([4, 0, 6, 1, 2, 5, 3])
    small = merged(planes, order, 3)
    assert small["sh_rest"].shape == (0, 3) and {values.shape[1] for values in small.values()} == {3}
    for group, rows in enumerate((order[:3], order[3:6], order[6:])):
        weights = light[rows] / light[rows].sum()
        means = planes["means"][:, rows].astype(np.float64)
        mean = means @ weights
        apart = means - mean[:, None]
        wanted = (apart * weights) @ apart.T + np.einsum("k,kij->ij", weights, covariances(planes)[rows])
        np.testing.assert_allclose(small["means"][:, group], mean, rtol=1e-5)
        np.testing.assert_allclose(small["sh_dc"][:, group], planes["sh_dc"][:, rows] @ weights, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(covariances(small)[group], wanted, rtol=1e-3, atol=1e-3 * wanted.max())


def test_a_row_alone_stays_and_light_is_kept() -> None:
    planes, light = scene(40)
    alone = merged(planes, np.arange(40), 1)
    np.testing.assert_allclose(covariances(alone), covariances(planes), rtol=1e-3, atol=1e-7)
    opacity = 1 / (1 + np.exp(-planes["opacity_logits"].astype(np.float64)))
    kept = 1 / (1 + np.exp(-alone["opacity_logits"].astype(np.float64)))
    np.testing.assert_allclose(kept, np.minimum(opacity, MOST_OPACITY), rtol=1e-4)
    twins = {name: np.repeat(values[:, :1], 2, axis=1) for name, values in planes.items()}
    twins["opacity_logits"][:] = np.log(0.3 / 0.7)
    both = merged(twins, np.arange(2), 2)["opacity_logits"][0, 0]
    assert 1 / (1 + np.exp(-both)) == pytest.approx(0.6, rel=1e-3)
