"""The same bits however the work is cut: forms, batches, chunks, memory limits, threads, runs."""

from __future__ import annotations

import hashlib
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.packed.quantize import QuantizedScene
from flexgs_edge.render.fit import sum_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.source import SceneSource
from flexgs_edge.units import parse_size
from kernel_fixtures import ALL_FORMS, FORMS, default_device, large_budget, open_form
from quantized_scenes import quantize_all
from synthetic import look_from, make_camera, random_scene

ROWS = 5000
SCENE = random_scene(ROWS, 21, 3, size=-3.2)
FORM = "w8"


def cameras() -> list[Camera]:
    rotation, translation = look_from(2)
    return [make_camera(70, 50), make_camera(70, 50, rotation=rotation, translation=translation)]


def digest(
    backend: Backend, budget: MemoryBudget, source: SceneSource = SCENE, views: list[Camera] | None = None
) -> str:
    """A hash over images, coverage and statistics of the views."""
    renderer = Renderer(backend, budget, background=(0.1, 0.2, 0.3))
    total = hashlib.sha256()
    statistics = Statistics.zeros(source.count)
    with renderer.load(source) as scene:
        for camera in views or cameras():
            total.update(renderer.render(scene, camera).tobytes())
            total.update(np.float64(renderer.drawn_coverage()).tobytes())
            renderer.add_statistics(scene, camera, statistics)
    renderer.release()
    assert statistics.hits.sum() > ROWS
    total.update(statistics.hits.tobytes())
    total.update(statistics.weights.tobytes())
    return total.hexdigest()


@pytest.fixture(scope="module")
def expected() -> str:
    return digest(open_form("w16"), large_budget())


@pytest.mark.parametrize("form", ALL_FORMS)
def test_forms(form: str, expected: str) -> None:
    assert digest(open_form(form), large_budget()) == expected


@pytest.mark.parametrize("form", FORMS)
def test_repeated_runs(form: str) -> None:
    renderer = Renderer(open_form(form), large_budget())
    with renderer.load(SCENE) as scene:
        images = [renderer.render(scene, camera).tobytes() for camera in cameras() * 3]
    renderer.release()
    assert images[:2] * 3 == images


@pytest.mark.parametrize("form", ALL_FORMS)
@pytest.mark.parametrize("pairs", [1, 777, 20000])
def test_pair_capacity(form: str, pairs: int, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, pairs=pairs)
    assert digest(open_form(form), large_budget()) == expected


@pytest.mark.parametrize("form", ALL_FORMS)
@pytest.mark.parametrize("rows", [1024, 1000, 4999])
def test_chunk_rows(form: str, rows: int, expected: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, chunk_rows=rows)
    assert digest(open_form(form), large_budget()) == expected


def test_order_of_views() -> None:
    """Sums are exact: views in any order, views in two halves."""
    renderer = Renderer(open_form(FORM), large_budget())
    with renderer.load(SCENE) as scene:
        forth, back, first, second = (Statistics.zeros(ROWS) for _ in range(4))
        for statistics, views in (
            (forth, cameras()),
            (back, cameras()[::-1]),
            (first, cameras()[:1]),
            (second, cameras()[1:]),
        ):
            for camera in views:
                renderer.add_statistics(scene, camera, statistics)
    renderer.release()
    for total in (back, Statistics(first.hits + second.hits, first.weights + second.weights)):
        np.testing.assert_array_equal(total.hits, forth.hits)
        np.testing.assert_array_equal(total.weights, forth.weights)


def run_within(limit: int, numpy: bool, quantized: QuantizedScene | None = None) -> tuple[str, bool]:
    """Images, coverage and statistics under a memory limit as a hash, and whether the scene stayed resident."""
    budget = MemoryBudget(limit)
    backend = TwinBackend(budget) if numpy else OpenCLBackend(default_device(), budget, width=8)
    renderer = Renderer(backend, budget)
    statistics, total = Statistics.zeros(ROWS), hashlib.sha256()
    with renderer.load(SCENE) if quantized is None else renderer.load_quantized(quantized) as scene:
        for camera in cameras():
            total.update(renderer.render(scene, camera).tobytes())
            total.update(np.float64(renderer.drawn_coverage()).tobytes())
            renderer.add_statistics(scene, camera, statistics)
        resident = scene.resident
    renderer.release()
    assert budget.used == 0  # everything was given back
    total.update(statistics.hits.tobytes())
    total.update(statistics.weights.tobytes())
    return total.hexdigest(), resident


@pytest.mark.parametrize("numpy", [False, True], ids=["opencl", "numpy"])
@pytest.mark.parametrize("quantized", [False, True], ids=["source", "quantized"])
def test_memory_limits(numpy: bool, quantized: bool) -> None:
    """Limits in steps: refused up to the smallest that does, then the same bits, streamed first, resident later."""
    scene = quantize_all(SCENE) if quantized else None
    expected, resident = run_within(1 << 32, numpy, scene)
    assert resident
    results = {}
    for limit in (900_000, 1_200_000, 1_600_000, 2_000_000, 2_800_000, 4_500_000):
        try:
            results[limit] = run_within(limit, numpy, scene)
        except BudgetError:
            assert not results, f"{limit} is refused, {max(results)} is enough"
    streamed = [limit for limit, (_, resident) in results.items() if not resident]
    assert streamed and len(streamed) < len(results), results
    assert {result for result, _ in results.values()} == {expected}


@pytest.mark.parametrize("numpy", [False, True], ids=["opencl", "numpy"])
def test_the_smallest_limit_is_named(numpy: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    """One error for the scene, one for the view and one for its statistics at most; the last one's limit is enough."""
    monkeypatch.setattr("flexgs_edge.memory.budget.ROOM", 0)  # more than all of this scene needs
    limit = 1 << 10
    errors: list[str] = []
    while len(errors) < 4:
        try:
            run_within(limit, numpy)
            break
        except BudgetError as error:
            match = re.search(r"use --memory-limit (\d+MiB) or more", str(error))
            assert match and parse_size(match.group(1)) > limit, error
            limit = parse_size(match.group(1))
            errors.append(str(error))
    assert 1 <= len(errors) <= 3, errors
    if limit > 1 << 20:
        with pytest.raises(BudgetError):
            run_within(limit - (1 << 20), numpy)


def test_costs_of_a_streamed_scene() -> None:
    """Measured costs hold sums for every chunk: the same bits resident, streamed, and in chunks of any size."""
    found = {}
    for limit in (1 << 32, 2_060_000, 2_360_000, 3_160_000):
        budget = MemoryBudget(limit)
        renderer = Renderer(OpenCLBackend(default_device(), budget, width=8), budget)
        with renderer.load(SCENE, sum_bytes(2) + cost_bytes(SCENE.sh_degree)) as scene:
            costs = measure_costs(renderer, scene, cameras())
            found[limit] = scene.resident, (costs.removal.tobytes(), costs.sh.tobytes(), costs.sh_mean.tobytes())
        renderer.release()
    assert [resident for resident, _ in found.values()] == [True, False, False, True]
    assert len({values for _, values in found.values()}) == 1


def test_views_of_other_sizes(expected: str) -> None:
    """Buffers follow the view's size: what was drawn before leaves no trace."""
    renderer = Renderer(open_form(FORM), large_budget())
    with renderer.load(SCENE) as scene:
        first = renderer.render(scene, cameras()[0])
        small = renderer.render(scene, make_camera(1, 1))
        assert small.shape == (1, 1, 3)
        assert renderer.render(scene, make_camera(33, 100)).shape == (100, 33, 3)
        np.testing.assert_array_equal(renderer.render(scene, cameras()[0]), first)
    renderer.release()


@pytest.mark.parametrize("antialiased", [False, True])
def test_every_second_pixel_is_the_whole_view_at_these_pixels(antialiased: bool) -> None:
    renderer = Renderer(open_form(FORM), large_budget(), antialiased=antialiased)
    with renderer.load(SCENE) as scene:
        for camera in cameras():
            whole = renderer.render(scene, camera)
            part = renderer.render(scene, camera.every(2, 1, 0))
            # But for roundings where a splat ends, at alpha 1/255.
            np.testing.assert_allclose(part, whole[::2, 1::2], atol=1.1 / 255)
            assert np.abs(part - whole[::2, 1::2]).mean() < 1e-5
    renderer.release()


@pytest.mark.parametrize("threads", [1, 2])
def test_thread_counts(threads: int, expected: str) -> None:
    """A fresh process with PoCL held to one and to two threads (so also another number of sort blocks)."""
    code = (
        "from kernel_fixtures import default_device, large_budget, open_form\n"
        "from test_render_invariance import digest\n"
        "print(default_device().compute_units, digest(open_form('w16'), large_budget()))"
    )
    paths = os.pathsep.join([str(Path(__file__).parents[1] / "helpers"), *filter(None, sys.path)])
    environment = {**os.environ, "POCL_MAX_PTHREAD_COUNT": str(threads), "PYTHONPATH": paths}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    units, result = done.stdout.split()
    if "Portable Computing" in default_device().platform and (os.cpu_count() or 1) > 1:
        assert int(units) == threads
    assert result == expected
