"""Efforts: who descends, and at which pixels of which poses scenes are scored."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flexgs_edge.methods.best.effort import (
    EFFORTS,
    FINE_PASSES,
    LARGEST_STEP,
    LEAST_STEPS,
    MANY_POSES,
    effort_of,
    finetune_steps,
    sampled_poses,
    sampling_steps,
)
from flexgs_edge.run.options import CompressOptions
from known_rounds import EFFORT
from synthetic import make_camera


def test_efforts_grow() -> None:
    fast, balanced, most = EFFORTS.values()
    for name in ("keep", "refit_rounds", "views", "passes"):
        assert getattr(fast, name) < getattr(balanced, name)
    assert fast.close > balanced.close and most is balanced


def test_who_descends() -> None:
    passes, least = EFFORTS["balanced"].passes, EFFORTS["balanced"].descends
    assert finetune_steps(CompressOptions(), 100, 1000 * least) == round(100 * passes)
    assert finetune_steps(CompressOptions(), 100, least, fine=True) == round(100 * passes * FINE_PASSES)
    assert finetune_steps(CompressOptions(), 2, least) == LEAST_STEPS
    assert finetune_steps(CompressOptions(), 4 * MANY_POSES, least) == round(2 * MANY_POSES * passes)
    assert finetune_steps(CompressOptions(), 100, least - 1) == 0 < finetune_steps(CompressOptions(), 100, least)
    assert finetune_steps(CompressOptions(distil=7), 100, least - 1) == 7

    for words in ({"distil": 0}, {"refit": False}, {"effort": "fast"}):
        assert finetune_steps(CompressOptions(**words), 100, least) == 0, words


@pytest.mark.parametrize(
    ("automatic", "words", "descends"),
    [
        (False, {}, True),
        (False, {"distil": 7}, False),
        (True, {"max_drop": 1.0}, False),
        (True, {"max_size": 10}, True),
    ],
)
def test_who_descends_between_rounds(automatic: bool, words: dict[str, Any], descends: bool) -> None:
    target = SimpleNamespace(limit_bytes=words.get("max_size"))
    run: Any = SimpleNamespace(
        options=CompressOptions(**words), seen=SimpleNamespace(automatic=automatic), target=target
    )
    assert (effort_of(run).interleaved > 0) == descends


@pytest.mark.parametrize(
    ("count", "step"), [(10, LARGEST_STEP), (113, 3), (120, 2.90625), (256, 2), (1030, 1), (10**6, 1)]
)
def test_poses_have_as_many_pixels_as_the_rows_need(count: int, step: float) -> None:
    cameras = [make_camera(64, 48) for _ in range(8)]
    assert sampling_steps(cameras, 24 * count) == [step] * 8
    assert sampling_steps(cameras, 24 * count, 0.5) == sampling_steps(cameras, 48 * count)
    assert sampling_steps(cameras, 24 * count, 0.0) == [1] * 8
    sampled = sampled_poses(cameras, [step] * 8)
    pixels = sum(camera.width * camera.height for camera in sampled)
    assert pixels == pytest.approx(sum(64 * 48 / step**2 for _ in cameras), rel=0.04)
    # Not the same lattice in every view, and none beyond the last pixels.
    assert len({(camera.cx, camera.cy) for camera in sampled}) == (8 if step > 1 else 1)
    for camera, whole in zip(sampled, cameras, strict=True):
        first = whole.cx - step * camera.cx, whole.cy - step * camera.cy
        for at, count_, side in zip(first, (camera.width, camera.height), (64, 48), strict=True):
            assert -1e-9 <= at < step and side - 1 - step < at + step * (count_ - 1) <= side - 1 + 1e-9


def test_poses_get_pixels_by_their_weights() -> None:
    """In proportion, between all of them and those of the largest distance; never fewer in all than the rows need."""
    cameras = [make_camera(64, 48) for _ in range(4)]
    weights = np.array([1.0, 0.25, 1 / 9, 1e-6])
    assert sampling_steps(cameras, 1, weights=weights) == [4, 4, 4, 4]
    assert sampling_steps(cameras, 4370, weights=weights) == [1, 2, 3, 4]
    assert sampling_steps(cameras, 2000, weights=weights) == [1.53125, 3.09375, 4, 4]
    assert sampling_steps(cameras, 4 * 64 * 48, weights=weights) == [1, 1, 1, 1]
    for pixels in range(800, 12_000, 700):
        steps = sampling_steps(cameras, pixels, weights=weights)
        assert steps == sorted(steps) and sum(64 * 48 / step**2 for step in steps) >= pixels


def test_large_scenes_are_scored_from_more_poses() -> None:
    effort = replace(EFFORT, few=3, views=6, pixels=10)
    pixels = [100] * 9
    assert [effort.poses_of(pixels, count) for count in (1, 30, 31, 40, 41, 60, 1000)] == [3, 3, 4, 4, 5, 6, 6]
    assert effort.poses_of(pixels[:2], 1) == effort.poses_of(pixels[:2], 1000) == 2
