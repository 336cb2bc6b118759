"""Views in so little memory that scenes must leave the device, or be cut anew."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.costs import cost_bytes, measure_costs
from flexgs_edge.render.fit import SUM_BYTES, sum_bytes
from flexgs_edge.render.renderer import Renderer
from kernel_fixtures import large_budget
from quantized_scenes import quantize_all
from synthetic import make_camera, random_scene

SCENE = random_scene(3000, 21, 3, size=-3.2)
CODES = quantize_all(SCENE)
SMALL, LARGE = make_camera(24, 16), make_camera(112, 80)


def scarce(sums: int = SUM_BYTES) -> Iterator[Renderer]:
    """With less and less memory, as long as each of two scenes alone can be drawn beside the codes of one."""
    for limit in range(3 << 20, 0, -(96 << 10)):
        budget = MemoryBudget(limit)
        renderer = Renderer(TwinBackend(budget), budget)
        try:
            with renderer.load_quantized(CODES) as codes:
                with renderer.load(SCENE, sums) as scene:
                    renderer.render(scene, LARGE)
                renderer.release()
                renderer.render(codes, LARGE)
        except BudgetError:
            return
        renderer.release()
        yield renderer


def test_a_scene_leaves_the_device_for_the_view_of_another() -> None:
    """Two scenes at once need no more memory than one after the other."""
    free = Renderer(TwinBackend(large_budget()), large_budget())
    with free.load_quantized(CODES) as scene:
        expected = free.render(scene, LARGE).tobytes()
    left = 0
    for renderer in scarce():
        with renderer.load_quantized(CODES) as first:
            assert renderer.render(first, LARGE).tobytes() == expected
            stayed = first.resident
            with renderer.load(SCENE) as second:
                renderer.render(second, LARGE)
            left += stayed and not first.resident
            assert renderer.render(first, LARGE).tobytes() == expected
        renderer.release()
        assert not renderer.budget.evictors
        assert not renderer.budget.used
    assert left


def test_a_scene_whose_values_move_stays() -> None:
    budget = large_budget()
    renderer = Renderer(TwinBackend(budget), budget)
    with renderer.load(SCENE) as scene:
        renderer.render(scene, SMALL)
        scene.stay()
        renderer.release()
        budget.limit = budget.used + (64 << 10)
        with renderer.load(SCENE) as other, pytest.raises(BudgetError):
            renderer.render(other, SMALL)
        assert scene.resident
    assert not budget.evictors


def test_a_larger_view_cuts_a_scene_anew() -> None:
    """A small view leaves room for the whole scene, or for large chunks; a larger one does not."""
    cut = 0
    for renderer in scarce():
        with renderer.load(SCENE) as scene:
            renderer.render(scene, SMALL)
            before = len(scene.starts)
            renderer.render(scene, LARGE)
            cut += len(scene.starts) > before
        renderer.release()
    assert cut


def test_sums_over_views_of_two_sizes_belong_to_the_same_chunks() -> None:
    """A scene that was cut for its first view stays cut so, although a smaller one leaves room for larger chunks."""
    room, views = cost_bytes(3) + sum_bytes(2), [LARGE, SMALL, LARGE]
    ample = Renderer(TwinBackend(large_budget()), large_budget())
    with ample.load(SCENE, room) as scene:
        expected = measure_costs(ample, scene, views)
    cut = 0
    for renderer in scarce(room):
        with renderer.load(SCENE, room) as scene:
            found = measure_costs(renderer, scene, views)
            cut += not scene.resident
        renderer.release()
        assert found.removal.tobytes() == expected.removal.tobytes()
        assert found.sh.tobytes() == expected.sh.tobytes()
    assert cut


def test_a_limit_that_no_view_fits_is_an_error() -> None:
    budget = MemoryBudget(1 << 16)
    renderer = Renderer(TwinBackend(budget), budget)
    with renderer.load(SCENE) as scene, pytest.raises(BudgetError, match="a view of 3000 Gaussians"):
        renderer.render(scene, LARGE)
