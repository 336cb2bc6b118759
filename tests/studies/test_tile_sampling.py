"""Fidelity from a sample of tiles: exact when all are looked at, unbiased, and intervals that hold as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexgs_edge.constants import TILE
from flexgs_edge.errors import InputError
from flexgs_edge.quality.psnr import mean_psnr, mse, psnr
from flexgs_edge.studies.speed.tile_sampling import TileSampler, tile_errors, tile_values

SIZES = [(100, 130), (64, 96), (90, 75)]
TRIALS = 200


def tiles_of(height: int, width: int) -> int:
    return math.ceil(height / TILE) * math.ceil(width / TILE)


@pytest.fixture(scope="module")
def maps() -> list[np.ndarray]:
    """Errors of a few very bad tiles and many good ones, as pruning leaves them."""
    rng = np.random.default_rng(5)
    return [np.exp(rng.normal(0.0, 1.7, tiles_of(*size))) for size in [(360, 480)] * 4]


def truth_of(maps: list[np.ndarray], values: list[np.ndarray]) -> float:
    found = mean_psnr([psnr(float(errors.sum() / of_view.sum())) for errors, of_view in zip(maps, values)])
    assert found is not None
    return found


@pytest.mark.parametrize("size", [*SIZES, (1, 1), (16, 17)])
def test_tiles_sum_to_the_mean_squared_error(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(1)
    a, b = rng.normal(0.5, 0.6, (2, *size, 3)).astype(np.float32)
    errors, values = tile_errors(a, b), tile_values(*size)
    assert errors.shape == values.shape == (tiles_of(*size),) and values.sum() == a.size
    assert errors.sum() / a.size == pytest.approx(mse(a, b), rel=1e-12)
    corner = np.clip(a[:TILE, :TILE], 0, 1).astype(float) - np.clip(b[:TILE, :TILE], 0, 1)
    assert errors[0] == pytest.approx(np.square(corner).sum())


def test_a_sample_of_everything_is_the_whole_measurement() -> None:
    rng = np.random.default_rng(2)
    pairs = [rng.uniform(0, 1, (2, *size, 3)).astype(np.float32) for size in SIZES]
    maps = [tile_errors(a, b) for a, b in pairs]
    sampler = TileSampler([tile_values(*size) for size in SIZES], 1.0)
    drawn = sampler.draw(0)
    assert sorted(drawn) == list(range(sum(map(len, maps))))
    found = sampler.estimate(drawn, np.concatenate(maps)[drawn])
    assert found.fidelity == pytest.approx(mean_psnr([psnr(mse(a, b)) for a, b in pairs]), abs=1e-9)
    assert found.error == pytest.approx(np.mean([mse(a, b) for a, b in pairs]))
    assert (found.half_width, found.error_deviation, found.share) == (0.0, 0.0, 1.0)
    assert found.covers(found.fidelity) and not found.covers(found.fidelity + 0.01) and not found.covers(None)


@pytest.mark.parametrize("noise", [None, 0.1, 0.8])
def test_intervals_hold_as_often_as_they_say(maps: list[np.ndarray], noise: float | None) -> None:
    values, rng = [tile_values(360, 480)] * 4, np.random.default_rng(9)
    # What an earlier step found: the same errors, each off by some factor.
    expected = None if noise is None else [errors * np.exp(rng.normal(0, noise, len(errors))) for errors in maps]
    sampler, errors = TileSampler(values, 0.2, expected), np.concatenate(maps)
    truth = truth_of(maps, values)
    found = [sampler.estimate(drawn, errors[drawn]) for drawn in map(sampler.draw, range(TRIALS))]
    # Heavy tails without any knowledge of them: the largest tiles are missed more often than a normal law says.
    assert (170 if noise is None else 180) <= sum(estimate.covers(truth) for estimate in found) <= 198
    off = np.array([(estimate.fidelity or 0.0) - truth for estimate in found])
    assert abs(off.mean()) < 4 * off.std() / math.sqrt(TRIALS) + 0.02
    widths = np.array([estimate.half_width for estimate in found])
    assert 1.96 * off.std() == pytest.approx(widths.mean(), rel=0.25)
    assert all(estimate.share <= 0.2 for estimate in found)


def test_knowing_more_makes_intervals_narrower(maps: list[np.ndarray]) -> None:
    values, errors = [tile_values(360, 480)] * 4, np.concatenate(maps)
    rng = np.random.default_rng(3)
    near = [e * np.exp(rng.normal(0, 0.2, len(e))) for e in maps]
    far = [e * np.exp(rng.normal(0, 0.7, len(e))) for e in maps]
    widths = []
    for expected, share in ((near, 0.2), (far, 0.2), (None, 0.2), (None, 0.1)):
        sampler = TileSampler(values, share, expected)
        found = [sampler.estimate(drawn, errors[drawn]).half_width for drawn in map(sampler.draw, range(20))]
        widths.append(np.mean(found))
    assert widths == sorted(widths)


def test_the_same_seed_draws_the_same_tiles(maps: list[np.ndarray]) -> None:
    values = [tile_values(360, 480)] * 4
    one, other = TileSampler(values, 0.1, maps), TileSampler(values, 0.1, maps)
    assert np.array_equal(one.draw(4), other.draw(4)) and not np.array_equal(one.draw(4), one.draw(5))
    assert len(set(one.draw(4))) == len(one.draw(4))
    # The worst tiles are looked at in every sample.
    worst = {int(errors.argmax()) + len(errors) * view for view, errors in enumerate(maps)}
    assert all(worst <= set(one.draw(seed)) for seed in range(10))


def test_pictures_without_error_and_small_pictures_have_an_estimate() -> None:
    values = [tile_values(10, 10), tile_values(40, 40)]
    sampler = TileSampler(values, 0.05, [np.zeros(1), np.zeros(9)])
    drawn = sampler.draw(0)
    found = sampler.estimate(drawn, np.zeros(len(drawn)))
    assert (found.fidelity, found.error, found.half_width) == (None, 0.0, 0.0) and found.covers(None)
    one = sampler.estimate(drawn, np.where(drawn == 0, 3.0, 0.0))
    assert one.fidelity == pytest.approx(20.0) and one.error == pytest.approx(0.005)


def test_bad_words_are_refused() -> None:
    for share in (0.0, 1.1, math.nan):
        with pytest.raises(InputError, match="expected a share above 0"):
            TileSampler([tile_values(20, 20)], share)
    with pytest.raises(InputError, match="cannot be compared"):
        tile_errors(np.zeros((3, 4, 3)), np.zeros((4, 3, 3)))
