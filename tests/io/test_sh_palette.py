"""Palettes and codebooks: near the best there is, exact where they can be, and the same for any order of sums."""

from __future__ import annotations

import numpy as np
import pytest

from flexgs_edge.io.sh_palette import best_codebook, nearest_codes, sh_palette


def least_error(values: np.ndarray, size: int) -> float:
    """The squared error of the best codebook, by trying every cut."""
    ordered = np.sort(values).astype(np.float64)
    count = len(ordered)
    best = np.full((size + 1, count + 1), np.inf)
    best[0, 0] = 0
    for used in range(1, size + 1):
        for stop in range(1, count + 1):
            parts = [ordered[start:stop] for start in range(stop)]
            best[used, stop] = min(
                best[used - 1, start] + float(np.square(part - part.mean()).sum()) for start, part in enumerate(parts)
            )
    return float(best[size, count])


@pytest.mark.parametrize(("count", "size"), [(20, 4), (40, 7), (60, 13), (30, 2), (30, 1)])
def test_codebooks_are_the_best(count: int, size: int) -> None:
    values = (np.random.default_rng(count).normal(size=count) ** 3).astype(np.float32)
    codebook = best_codebook(values, size=size)
    error = np.square(values - codebook[nearest_codes(codebook, values)]).sum()
    assert len(codebook) == size and error == pytest.approx(least_error(values, size), rel=1e-5)


def test_codebooks_of_many_values() -> None:
    """Close to the least error that theory has for normal values: sqrt(3) pi / 2 over the square of the number of codes."""
    values = np.random.default_rng(1).normal(size=200_000).astype(np.float32)
    codebook = best_codebook(values)
    assert len(codebook) == 256 and np.all(np.diff(codebook) > 0)
    assert np.square(values - codebook[nearest_codes(codebook, values)]).mean() * 256**2 < 1.02 * np.sqrt(3) * np.pi / 2


def test_codebooks_of_odd_values() -> None:
    few = np.array([3, 1, 1, -2, 3], np.float32)
    assert best_codebook(few).tolist() == [-2, 1, 3] and nearest_codes(best_codebook(few), few).tolist() == [
        2,
        1,
        1,
        0,
        2,
    ]
    assert best_codebook(np.full(9, 0.1, np.float32)).tolist() == [float(np.float32(0.1))]
    # Many equal values and one far away leave enough codes for the rest.
    rare = np.concatenate([np.zeros(100_000), np.linspace(0.1, 0.2, 3000), [1e6]]).astype(np.float32)
    codebook = best_codebook(rare)
    assert np.abs(rare - codebook[nearest_codes(codebook, rare)]).max() < 0.002
    weights = np.where(few == 3, 1000, 1)
    assert best_codebook(few, weights, 2).tolist() == [0, 3]


def test_a_palette_finds_clusters() -> None:
    rng = np.random.default_rng(2)
    middles = rng.normal(0, 1, (60, 24))
    truth = rng.integers(0, 60, 3000)
    values = (middles[truth] + rng.normal(0, 0.01, (3000, 24))).astype(np.float32)
    labels, palette = sh_palette(values, 60)
    assert palette.shape == (60, 24)
    assert len({(a, b) for a, b in zip(labels.tolist(), truth.tolist())}) == 60
    assert np.sqrt(np.square(values - palette[labels]).mean()) < 0.0102
    # Entries are numbered in the order of their first row.
    assert np.unique(labels, return_index=True)[1].tolist() == sorted(np.unique(labels, return_index=True)[1].tolist())


def test_a_palette_with_room_for_all_is_exact() -> None:
    rng = np.random.default_rng(3)
    values = rng.normal(0, 0.1, (50, 45)).astype(np.float32)
    values[[3, 8]] = 0
    labels, palette = sh_palette(np.concatenate([values, values]), 64)
    assert len(palette) == 49
    np.testing.assert_allclose(palette[labels], np.concatenate([values, values]), atol=1e-5)
    assert not palette[labels[3]].any() and labels[3] == labels[8]


def test_a_palette_beats_plain_k_means() -> None:
    """On a smooth spread without clusters, from more vectors than are merged: some are only assigned."""
    rng = np.random.default_rng(4)
    values = (rng.normal(0, 1, (3000, 4)) @ rng.normal(0, 1, (4, 9))).astype(np.float32)
    labels, palette = sh_palette(values, 128)
    error = np.square(values - palette[labels]).mean()
    centres = values[rng.permutation(3000)[:128]]
    for _ in range(10):
        nearest = np.square(values[:, None] - centres).sum(axis=2).argmin(axis=1)
        centres = np.stack(
            [values[nearest == i].mean(axis=0) if (nearest == i).any() else centres[i] for i in range(128)]
        )
    assert error < 1.02 * np.square(values - centres[nearest]).mean()


def test_extreme_vectors() -> None:
    """One wild vector neither breaks the others nor the sums."""
    values = np.random.default_rng(5).normal(0, 0.1, (400, 45)).astype(np.float32)
    values[7] = 1e14
    labels, palette = sh_palette(values, 256)
    assert np.isfinite(palette).all() and len(palette) <= 256
    np.testing.assert_allclose(palette[labels[7]], 1e14, rtol=1e-3)
    zeros = np.zeros((10, 9), np.float32)
    labels, palette = sh_palette(zeros, 2)
    assert palette.tolist() == [[0] * 9] and not labels.any()
