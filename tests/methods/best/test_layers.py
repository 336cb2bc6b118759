"""Which rows are worth most, and what sorting them takes."""

from __future__ import annotations

import tracemalloc
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.memory.storage import ScratchStorage
from flexgs_edge.methods.best.allocation import BitModel
from flexgs_edge.methods.best.costs import RemovalCosts
from flexgs_edge.methods.best.layers import SORTED_ROW_BYTES, worthiest
from flexgs_edge.methods.best.refit.finetune import FIELD_RATES
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, Planes, growth
from flexgs_edge.views.references import Original, References
from kernel_fixtures import large_budget, open_form
from synthetic import look_from, make_camera, random_scene

COUNT = 240
RATES = {"means": 5e-3, **FIELD_RATES}
DEGREES = (np.arange(COUNT) % 3).astype(np.uint8)


def view(seed: int) -> Camera:
    rotation, translation = look_from(seed)
    return make_camera(45, 37, rotation=rotation, translation=translation, name=f"v{seed}")


CAMERAS = [view(seed) for seed in range(5)]


@pytest.fixture
def original() -> Any:
    planes = scene()
    renderer = Renderer(open_form("w16"), large_budget())
    with renderer.load(MemorySource(planes)) as loaded:
        references = References.of(renderer, loaded, CAMERAS)
    yield Original(renderer, np.zeros(3), CAMERAS, references)
    references.close()
    renderer.release()


def scene() -> Planes:
    planes = random_scene(COUNT, 71, 2, size=-1.8).read(slice(0, COUNT), list(FIELD))
    planes["means"][:, -9:] = np.array([[0.0], [0.0], [-60.0]], np.float32)  # behind all cameras
    rest = planes["sh_rest"].reshape(3, 8, COUNT)
    rest[:, :3] *= DEGREES >= 1
    rest[:, 3:] *= DEGREES >= 2
    return planes


def alone(planes: Planes, inside: np.ndarray) -> Planes:
    """The layer as a viewer draws it."""
    some = {name: np.ascontiguousarray(values[..., inside]) for name, values in planes.items()}
    return {**some, "log_scales": some["log_scales"] + growth(int(inside.sum()), len(inside))}


def error(planes: Planes, original: Original) -> float:
    """Mean squared error from the original's renders."""
    renderer = original.renderer
    with renderer.load(MemorySource(scene())) as loaded:
        wanted = [renderer.render(loaded, camera) for camera in CAMERAS]
    with renderer.load(MemorySource(planes)) as loaded:
        found = [renderer.render(loaded, camera) for camera in CAMERAS]
    return float(np.mean([np.mean(np.square(a - b)) for a, b in zip(found, wanted, strict=True)]))


def test_rows_of_a_first_layer(original: Original) -> None:
    """It has the share that was asked for, none that no pose sees, and better rows than chance."""
    planes, bits = scene(), BitModel()
    spent = np.array([bits.of_degree(degree) for degree in range(3)])[DEGREES]

    def layer(share: float) -> np.ndarray:
        found = np.zeros(COUNT, bool)
        found[worthiest(planes, DEGREES, np.arange(COUNT), share, bits, original.renderer, CAMERAS, np.zeros(3))] = True
        return found

    inside = layer(0.3)
    assert 0.28 * spent.sum() < spent[inside].sum() <= 0.3 * spent.sum() and not inside[-9:].any()
    others = np.random.default_rng(3).permutation(inside)
    assert error(alone(planes, inside), original) < 0.8 * error(alone(planes, others), original)
    assert layer(1e-6).sum() == 1


def test_sorting_takes_as_much_memory_as_it_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Beside what lies in scratch files, however the costs fall. So many rows that what else is allocated hardly counts."""
    count, rng = 1 << 18, np.random.default_rng(5)
    storage = ScratchStorage(tmp_path, whole=1 << 10)
    planes = {name: storage.copy(np.zeros((FIELD[name].width(3), count), np.float32)) for name in FIELD}
    degrees = rng.integers(0, 4, count).astype(np.uint8)
    drawn: list[int] = []

    def measured(renderer: Renderer, scene: Any, *_: Any, **__: Any) -> RemovalCosts:
        drawn.append(scene)
        costs = RemovalCosts.empty(0, scene, storage)
        costs.removal[:], costs.weight2[:] = rng.random(scene), rng.random(scene) > 0.1
        return costs

    monkeypatch.setattr("flexgs_edge.methods.best.layers.measure_costs", measured)
    renderer = cast(Renderer, SimpleNamespace(storage=storage, load=lambda source, _: nullcontext(source.count)))
    tracemalloc.start()
    try:
        left = worthiest(planes, degrees, np.arange(count), 0.1, BitModel(), renderer, [], np.zeros(3))
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert drawn[0] == count and len(drawn) > 8 and 0 < len(left) < 0.2 * count
    assert peak < SORTED_ROW_BYTES * count, peak / count
