"""Descents whose state lies in files: the same bits as in memory."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.memory.storage import ScratchStorage
from flexgs_edge.methods.best.refit.descent import Descent, bit_prices
from flexgs_edge.methods.best.refit.finetune import FIELD_RATES
from flexgs_edge.methods.best.refit.streamed_descent import StreamedDescent
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from kernel_fixtures import FORMS, large_budget, open_form, same_bits
from synthetic import look_from, make_camera, random_scene

COUNT = 300
STEPS = StepSizes(0.03, 0.25, 0.06, 0.5, 0.15, (0.12, 0.12))
RATES = {"means": 5e-3, **FIELD_RATES}
ORIGIN = np.array([0.25, 0.0, -0.5])


def view(seed: int) -> Camera:
    rotation, translation = look_from(seed)
    return make_camera(45, 37, rotation=rotation, translation=translation, name=f"v{seed}")


def scene(degree: int = 2) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Rows with SH first. The last block is behind every camera, and the one before it is seen by some."""
    planes = random_scene(COUNT, 71, degree, size=-1.8).read(slice(0, COUNT), list(FIELD))
    degrees = np.where(np.arange(COUNT) < 170, np.arange(COUNT) % (degree + 1), 0).astype(np.uint8)
    planes["sh_rest"][:, degrees == 0] = 0
    planes["means"][:, -64:] = np.array([[0.0], [0.0], [-60.0]], np.float32)
    return planes, degrees


def course(descent: Any) -> dict[str, np.ndarray]:
    """Free steps, then steps on a grid with prices and a mean, then steps that hold geometry."""
    rng = np.random.default_rng(5)
    cameras = [view(seed) for seed in range(4)]
    targets = [rng.random((3, 48, 48)).astype(np.float16) for _ in cameras]
    held = {**RATES, "means": 0.0, "log_scales": 0.0, "quats": 0.0}
    with descent:
        planes, degrees = scene()
        descent.price(bit_prices(planes, degrees, STEPS, 0.01))
        for k in range(5):
            descent.step(cameras[k % 4], targets[k % 4], RATES)
        for rates in (RATES, held):
            if rates is held:
                descent.settle()
            descent.put_on(STEPS)
            for k in range(7):
                for share in [0.0] * (k % 3) + [max(1 / (k + 1), 0.4)]:
                    descent.step(cameras[k * k % 4], targets[k * k % 4], rates, share)
        descent.settle()
        moved: dict[str, np.ndarray] = descent.planes()
    return moved


@pytest.fixture
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, compact_rows=64, capacity_step=16)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.usefixtures("small_chunks")
def test_the_same_bits_as_in_memory(form: str, tmp_path: Path) -> None:
    planes, degrees = scene()
    renderer = Renderer(open_form(form), large_budget(), antialiased=form == "w16")
    whole = course(Descent(renderer, planes, degrees, ORIGIN, view(0), 0.01))
    storage = renderer.storage = ScratchStorage(tmp_path, 1 << 30, least=256)
    before, used = renderer.budget.used, storage.used
    parts = course(StreamedDescent(renderer, planes, degrees, ORIGIN, 0.01))
    for name, values in whole.items():
        assert not same_bits(values, planes[name]) and same_bits(np.asarray(parts[name]), values), name
    del parts, values
    renderer.release()
    assert renderer.budget.used <= before and storage.used == used


@pytest.mark.usefixtures("small_chunks")
def test_chunks_that_no_view_shows_are_not_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    planes, degrees = scene()
    renderer = Renderer(open_form("w16"), large_budget())
    renderer.storage = ScratchStorage(tmp_path, 1 << 30, least=256)
    rng = np.random.default_rng(5)
    with StreamedDescent(renderer, planes, degrees, ORIGIN) as descent:
        opened: list[int] = []
        move, load = descent._move, descent._planes.load
        monkeypatch.setattr(descent, "_move", lambda part, *rest: (opened.append(part.base), move(part, *rest)))
        loaded: list[int] = []
        monkeypatch.setattr(descent._planes, "load", lambda start, *rest: (loaded.append(start), load(start, *rest)))
        target = rng.random((3, 48, 48)).astype(np.float16)
        for _ in range(2):
            descent.step(view(0), target, RATES)
    starts = sorted(set(loaded))
    assert len(starts) > 4 and loaded.count(starts[-1]) == 1 and starts[-1] not in opened
    assert loaded.count(starts[0]) >= 2 and opened.count(starts[0]) == 2
    renderer.release()
