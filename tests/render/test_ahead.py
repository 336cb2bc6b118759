"""Views that are projected before their turn: the same bits, a part of the reading, and nothing left behind."""

from __future__ import annotations

import errno
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.storage import ScratchStorage
from flexgs_edge.render import ahead, fit
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.fit import GROWTH
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import default_device, large_budget
from synthetic import NotedSource, look_from, make_camera, random_scene

SCENE = random_scene(600, 5, 2)
CHUNKS = 10


def cameras(count: int) -> list[Camera]:
    """Views of one size."""
    return [make_camera(40, 30, rotation=look_from(seed)[0], translation=look_from(seed)[1]) for seed in range(count)]


def spilling(folder: Path, form: str = "numpy", budget: MemoryBudget | None = None) -> Renderer:
    """A renderer whose compact views may wait in scratch files."""
    budget = budget or large_budget()
    backend = TwinBackend(budget) if form == "numpy" else OpenCLBackend(default_device(), budget)
    renderer = Renderer(backend, budget)
    renderer.storage = ScratchStorage(folder)
    return renderer


def alone(views: Sequence[Camera], source: MemorySource = SCENE, backend: Backend | None = None) -> list[np.ndarray]:
    """Their pictures, one by one."""
    renderer = Renderer(backend or TwinBackend(large_budget()), large_budget())
    with renderer.load(source) as scene:
        found = [renderer.render(scene, camera) for camera in views]
    renderer.release()
    return found


@pytest.fixture
def noted(compact: None) -> NotedSource:
    """The scene, which notes the chunks that are read of it."""
    return NotedSource(SCENE)


@pytest.mark.parametrize("form", ["numpy", "opencl"])
@pytest.mark.parametrize("most", [0, 1, 3, 9])
def test_the_scene_is_read_once_for_several_views(
    form: str, most: int, noted: NotedSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_fit(monkeypatch, ahead=most)
    views = cameras(8)
    renderer = spilling(tmp_path, form)
    used = renderer.budget.used
    with renderer.load(noted) as scene:
        renderer.render(scene, views[0])
        scene.shown = SCENE.count  # room for whatever a view shows
        renderer.release()
        noted.reads.clear()
        found = [renderer.render(scene, camera) for camera in renderer.in_turn(scene, views)]
        assert 0 < len(noted.reads) <= CHUNKS * -(-len(views) // (most + 1))
        rows = [renderer.view_rows for camera in views if renderer.render(scene, camera) is not None]
    renderer.release()
    assert renderer.budget.used == used
    assert all(row is not None and len(row) for row in rows)
    for image, expected in zip(found, alone(views, backend=renderer.backend), strict=True):
        np.testing.assert_array_equal(image, expected)


def test_a_view_without_room_is_counted_before_it_gets_some(compact: None, tmp_path: Path) -> None:
    """One pass finds that there is too little room, one how much is needed; no more are made for what the first four show."""
    views, renderer, wide = cameras(4), spilling(tmp_path), NotedSource(random_scene(600, 7, 1, size=-3.0, spread=4.0))
    rows = []
    with renderer.load(wide) as scene:
        found = []
        for camera in renderer.in_turn(scene, views):
            found.append(renderer.render(scene, camera))
            assert renderer.view_rows is not None
            rows.append(len(renderer.view_rows))
        assert 0 < len(wide.reads) <= 2 * CHUNKS
        assert scene.shown is not None and max(rows) <= scene.shown <= GROWTH * max(rows) + fit.DEFAULT.capacity_step
        assert 100 < max(rows) < wide.count / GROWTH
    for image, expected in zip(found, alone(views, wide), strict=True):
        np.testing.assert_array_equal(image, expected)


def test_views_of_changed_values_do_not_wait(compact: None, tmp_path: Path) -> None:
    views, renderer = cameras(4), spilling(tmp_path)
    planes = {name: values.copy() for name, values in SCENE.read(slice(0, SCENE.count), list(FIELD)).items()}
    found = []
    with renderer.load(MemorySource(planes)) as scene:
        for place, camera in enumerate(renderer.in_turn(scene, views)):
            if place == 2:
                planes["sh_dc"] += np.float32(0.5)
                scene.refresh("sh_dc")
            found.append(renderer.render(scene, camera))
    expected = [*alone(views[:2]), *alone(views[2:], MemorySource(planes))]
    for image, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(image, other)
    assert np.any(expected[3] != alone(views)[3])


def test_another_scene_between_two_views(compact: None, tmp_path: Path) -> None:
    """As when what was drawn is compared with what has to be drawn for that."""
    views, renderer, other = cameras(4), spilling(tmp_path), random_scene(300, 9, 2)
    with renderer.load(SCENE) as scene:
        for place, camera in enumerate(renderer.in_turn(scene, views)):
            np.testing.assert_array_equal(renderer.render(scene, camera), alone(views)[place])
            with renderer.load(other) as between:
                image = renderer.render(between, camera)
                np.testing.assert_array_equal(image, alone([camera], other)[0])
                for inner in renderer.in_turn(between, views[:place]):
                    np.testing.assert_array_equal(renderer.render(between, inner), alone([inner], other)[0])


def test_a_loop_that_is_left_leaves_nothing(compact: None, tmp_path: Path) -> None:
    views, renderer = cameras(4), spilling(tmp_path)
    used = renderer.budget.used
    with renderer.load(SCENE) as scene:
        turns = renderer.in_turn(scene, views)
        renderer.render(scene, next(turns))
        files, shown = (
            [view._file for view in renderer._ahead._waiting],
            [view.count for view in renderer._ahead._waiting],
        )
        assert len(files) == 3 and not any(file.closed for file in files)
        assert (
            isinstance(renderer.storage, ScratchStorage)
            and renderer.storage.used == sum(shown) * ahead.AHEAD_ROW_BYTES > 0
        )
        del turns
        assert all(file.closed for file in files) and renderer.storage.used == 0
    renderer.release()
    assert renderer.budget.used == used


def test_pieces_of_any_size_are_written_and_read(
    compact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng, views, renderer = np.random.default_rng(0), cameras(4), spilling(tmp_path)
    for name in ("pwritev", "preadv"):
        plain = getattr(os, name)

        def some(descriptor: int, parts: Sequence[memoryview], at: int, plain: Any = plain) -> int:
            return int(plain(descriptor, [parts[0][: int(rng.integers(1, 200))]], at))

        monkeypatch.setattr(os, name, some)
    with renderer.load(SCENE) as scene:
        for camera, expected in zip(renderer.in_turn(scene, views), alone(views), strict=True):
            np.testing.assert_array_equal(renderer.render(scene, camera), expected)


def test_a_full_disk_is_an_error(compact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    views, renderer = cameras(4), spilling(tmp_path)

    def full(*_: Any) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwritev", full)
    with renderer.load(SCENE) as scene, pytest.raises(BudgetError, match="the disk is full"):
        for camera in renderer.in_turn(scene, views):
            renderer.render(scene, camera)
    assert not renderer._ahead._waiting


def test_systems_without_such_calls_read_again(
    noted: NotedSource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(os, "pwritev")
    views, renderer = cameras(3), spilling(tmp_path)
    with renderer.load(noted) as scene:
        for camera, expected in zip(renderer.in_turn(scene, views), alone(views), strict=True):
            np.testing.assert_array_equal(renderer.render(scene, camera), expected)
    assert len(noted.reads) > 2 * CHUNKS


def test_lists_of_tiles_leave_room_for_chunks(compact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever the limit, a view is drawn, or refused with one that does: chunks were forgotten, and failed in its middle."""
    use_fit(monkeypatch, least_rows=16)
    use_fit(monkeypatch, compact_rows=256)
    camera, drawn = cameras(1)[0], []
    least = large_budget()
    renderer = spilling(tmp_path, budget=least)
    held = least.used
    for limit in range(50_000, 500_000, 4_999):
        least.limit = held + limit
        try:
            with renderer.load(SCENE, sum_bytes=0) as scene:
                renderer.render(scene, camera)
                drawn.append(limit)
        except BudgetError as error:
            assert not drawn and "a view" in str(error)
        renderer.release()
    assert drawn and drawn[0] > 60_000


def test_views_wait_only_where_reading_costs(compact: None, tmp_path: Path) -> None:
    """Not in memory, and not outside a loop that tells what comes."""
    views, renderer = cameras(3), spilling(tmp_path)
    with renderer.load(SCENE) as scene:
        renderer.render(scene, views[0])
        assert not renderer._ahead._waiting
    renderer = Renderer(TwinBackend(large_budget()), large_budget())
    with renderer.load(SCENE) as scene:
        for camera in renderer.in_turn(scene, views):
            renderer.render(scene, camera)
            assert isinstance(scene, DeviceScene) and scene.shown is not None and not renderer._ahead._waiting
