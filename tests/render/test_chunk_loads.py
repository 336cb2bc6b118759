"""Chunks that are loaded ahead: never into memory that is in use, in slots that are given back whatever happens."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.chunk_loads import MOST_SLOTS, SLOTS, ChunkLoads, Loading, Span
from flexgs_edge.render.chunks import SourcePlanes
from kernel_fixtures import default_device, large_budget
from synthetic import random_scene

SCENE = random_scene(200, 3, 1)
SPANS: list[Span] = [(start, min(start + 32, 200), 1) for start in range(0, 200, 32)]


class Planes(SourcePlanes):
    """Fails at one chunk, where that is wanted."""

    fails: int | None = None

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        if start == self.fails:
            raise OSError("the disk is gone")
        super().load(start, stop, planes)


@pytest.fixture
def budget() -> MemoryBudget:
    return large_budget()


def means_of(loading: Loading, span: Span) -> np.ndarray:
    backend = loading.arrays.backend
    means: np.ndarray = backend.read(loading.arrays.stored["means"])[:, : span[1] - span[0]]
    return means


@pytest.mark.parametrize("form", ["numpy", "opencl"])
@pytest.mark.parametrize("more", [False, True])
def test_one_or_two_are_loaded_ahead(form: str, more: bool, budget: MemoryBudget) -> None:
    backend = TwinBackend(budget) if form == "numpy" else OpenCLBackend(default_device(), budget)
    used, most = budget.used, MOST_SLOTS if more else SLOTS
    loads, slots = ChunkLoads(backend, Planes(backend, SCENE), lambda _: False, lambda _: more), set()
    for place, span in enumerate(SPANS):
        loading = loads.take(span)
        loads.go_on(SPANS[place + 1 :])
        assert len(loads._coming) == min(most - 1, len(SPANS) - place - 1)
        assert all(other.arrays is not loading.arrays for other in loads._coming.values())
        for other in loads._coming.values():
            other.future.result()
        np.testing.assert_array_equal(means_of(loading, span), SCENE.read(slice(*span[:2]), ["means"])["means"])
        slots.add(id(loading.arrays))
        loads.give_back(loading)
    assert len(slots) <= most  # the last chunk is shorter: it may take the place of another
    loads.close()
    assert budget.used == used


@pytest.mark.parametrize("more", [False, True])
def test_one_that_was_not_asked_for_comes_first(more: bool, budget: MemoryBudget) -> None:
    """A chunk that stayed gave its memory back after those behind it were asked for."""
    backend = TwinBackend(budget)
    loads = ChunkLoads(backend, Planes(backend, SCENE), lambda _: False, lambda _: more)
    loads.go_on(SPANS[2:])
    found = []
    for span in SPANS[1:4]:
        found.append(loads.take(span))
        loads.go_on(SPANS[SPANS.index(span) + 1 :])
        np.testing.assert_array_equal(means_of(found[-1], span), SCENE.read(slice(*span[:2]), ["means"])["means"])
        loads.give_back(found[-1])
    loads.close()


def test_those_that_stay_are_kept(budget: MemoryBudget) -> None:
    backend = TwinBackend(budget)
    used = budget.used
    loads = ChunkLoads(backend, Planes(backend, SCENE), lambda rows: True, lambda _: False)
    kept = loads.take(SPANS[0])
    loads.keep(kept)
    loads.go_on(SPANS[1:])  # not taken: given back
    loads.close()
    assert budget.used - used == sum(
        array.nbytes for array in (*kept.arrays.stored.values(), kept.arrays.cov, kept.arrays.log2_opacity)
    )
    kept.arrays.release()
    assert budget.used == used


@pytest.mark.parametrize("stays", [False, True])
def test_a_chunk_that_cannot_be_read_leaves_nothing(stays: bool, budget: MemoryBudget) -> None:
    backend = TwinBackend(budget)
    used, planes = budget.used, Planes(backend, SCENE)
    planes.fails = SPANS[1][0]
    loads = ChunkLoads(backend, planes, lambda _: stays, lambda _: True)
    loads.take(SPANS[0])
    loads.go_on(SPANS[1:])
    with pytest.raises(OSError, match="gone"):
        loads.take(SPANS[1])
    loads.close()
    assert budget.used == used
