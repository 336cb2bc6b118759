"""Splitting the splats of a view into batches whose pairs fit."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.view_buffers import PIECES, split_batches
from kernel_fixtures import large_budget, open_form
from synthetic import make_camera, random_scene


@pytest.mark.parametrize("form", ["numpy", "w8", "gpu"])
def test_batches_are_full_and_fit(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = 60_000
    use_fit(monkeypatch, pairs=9000)
    backend = open_form(form)
    renderer = Renderer(backend, large_budget())
    with renderer.load(random_scene(rows, 3, 0, size=-3.2)) as scene:
        drawn = renderer._prepare(scene, make_camera(150, 90))
        buffers, shown = drawn.buffers, renderer.splats_shown
        order = backend.read(buffers.sorted[0][1])[:shown]
        pairs = backend.read(buffers.bounds)[order].astype(np.int64)
        tracemalloc.start()
        batches = split_batches(backend, buffers, shown)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    renderer.release()
    assert drawn.batches == batches and len(batches) > 4
    starts, stops = zip(*batches)
    assert starts == (0, *stops[:-1]) and stops[-1] == shown
    sums = np.add.reduceat(pairs, starts)
    assert sums.max() <= buffers.capacity
    assert sums[:-1].min() >= buffers.capacity * (1 - 1 / PIECES) - pairs.max()
    if form != "numpy":  # whose arrays are on the host
        assert peak < 4 * shown, "the host must not hold a number for every splat"
