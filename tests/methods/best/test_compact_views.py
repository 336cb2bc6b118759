"""Views that hold only the rows that they see: the same pictures, sums and costs as views of whole scenes."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import CULLED
from flexgs_edge.errors import BudgetError
from flexgs_edge.kernels.backend import TwinBackend
from flexgs_edge.memory.storage import ScratchStorage
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.rounds import sum_row_bytes
from flexgs_edge.render.ahead import camera_record
from flexgs_edge.render.chunks import ChunkBounds, SourcePlanes
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original, References
from kernel_fixtures import FORMS, large_budget, open_form
from synthetic import NotedSource, joined, look_from, make_camera, random_scene

SCENE = joined(random_scene(700, 5, 2), random_scene(300, 6, 2, size=-1.0))


def cameras() -> list[Camera]:
    """Views of two sizes; one sees nothing."""
    views = []
    for seed, (width, height) in enumerate([(40, 30), (40, 30), (64, 20)]):
        rotation, translation = look_from(seed)
        views.append(make_camera(width, height, rotation=rotation, translation=translation, name=f"v{seed}"))
    rotation, _ = look_from(1)
    return [*views, make_camera(40, 30, rotation=rotation, translation=(0.0, 0.0, -50.0), name="nothing")]


def found_by(form: str, storage: ScratchStorage | None) -> dict[str, np.ndarray]:
    """Pictures, statistics, costs and refitted colours of the scene."""
    drawer = Renderer(open_form(form), large_budget())
    if storage is not None:
        drawer.storage = storage
    statistics = Statistics.zeros(SCENE.count)
    found: dict[str, np.ndarray] = {}
    with drawer.load(SCENE) as scene:
        for camera in cameras():
            found[camera.name] = drawer.render(scene, camera)
            drawer.add_statistics(scene, camera, statistics)
        assert (scene.shown is not None) == (storage is not None)
    found |= {"hits": statistics.hits, "weights": statistics.weights}
    with drawer.load(SCENE, 100) as scene, References() as references:
        costs = measure_costs(drawer, scene, cameras())
        found |= {name: getattr(costs, name) for name in ("removal", "weight2", "sh", "sh_mean")}
        planes = SCENE.read(slice(0, SCENE.count), list(FIELD))
        for view, camera in enumerate(cameras()):
            references.add(view, drawer.render_planes(scene, camera))
        planes["sh_dc"] = planes["sh_dc"] + np.float32(0.1)
        degrees = np.arange(SCENE.count) % 3
        moved = refit_colours(planes, degrees, Original(drawer, SCENE.origin, cameras(), references), 2, subsets=2)
    drawer.release()
    return {**found, "moved": moved["sh_dc"], "rest": moved["sh_rest"]}


@pytest.mark.parametrize("form", FORMS)
def test_compact_views_give_the_same_bits(
    form: str, compact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spilled = found_by(form, ScratchStorage(tmp_path))
    # Some chunks stay in memory.
    asked = itertools.count()
    monkeypatch.setattr(DeviceScene, "_may_stay", lambda *_: next(asked) % 3 == 0)
    for name, values in found_by(form, ScratchStorage(tmp_path)).items():
        np.testing.assert_array_equal(values, spilled[name], err_msg=name)
    # One chunk, so that it is the last one that shows more than there is room for.
    use_fit(monkeypatch, compact_rows=4096)
    for name, values in found_by(form, ScratchStorage(tmp_path)).items():
        np.testing.assert_array_equal(values, spilled[name], err_msg=name)
    monkeypatch.undo()
    plain = found_by(form, None)
    assert plain["removal"].any() and plain["hits"].any()
    for name, values in plain.items():
        np.testing.assert_array_equal(spilled[name], values, err_msg=name)


@pytest.mark.parametrize("form", FORMS)
def test_views_that_become_compact_have_smaller_chunks(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A view that showed the blocks of larger chunks wrote beyond its arrays."""
    use_fit(monkeypatch, resident=False, compact_rows=256)
    drawer = Renderer(open_form(form), large_budget())
    with drawer.load(SCENE) as scene:
        whole = drawer.render(scene, cameras()[0])
        larger = max(np.diff(scene.starts))
        scene.be_compact(SCENE.count)
        drawer.release()
        np.testing.assert_array_equal(drawer.render(scene, cameras()[0]), whole)
        assert max(np.diff(scene.starts)) < larger
    drawer.release()


def test_sums_of_a_chunk_take_the_place_of_a_view(
    compact: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the limit, costs are measured and colours refitted, or a view is refused before, with a limit that does."""
    use_fit(monkeypatch, compact_rows=512)
    planes, degrees = SCENE.read(slice(0, SCENE.count), list(FIELD)), np.full(SCENE.count, 2)
    views, drawn = cameras()[:2], list[int]()
    budget = large_budget()
    drawer = Renderer(TwinBackend(budget), budget)
    drawer.storage, held = ScratchStorage(tmp_path), budget.used
    with References() as references:
        with drawer.load(SCENE) as scene:
            for view, camera in enumerate(views):
                references.add(view, drawer.render_planes(scene, camera))
        drawer.release()
        for limit in range(250_000, 750_000, 40_013):
            budget.limit = held + limit
            try:
                with drawer.load(SCENE, sum_row_bytes(SCENE.sh_degree), view_sums=2) as scene:
                    measure_costs(drawer, scene, views)
                refit_colours(planes, degrees, Original(drawer, SCENE.origin, views, references), 1)
                drawn.append(limit)
            except BudgetError as error:
                assert not drawn and "a view" in str(error)
            drawer.release()
            assert budget.used == held
    assert drawn and drawn[0] > 250_000


@pytest.mark.parametrize("seed", range(4))
def test_chunks_that_stay_give_way(seed: int, compact: None) -> None:
    """They are read once, unless memory is wanted for something else, at any moment; the one that is used is never taken."""
    rng, backend, budget = np.random.default_rng(seed), open_form("w8"), large_budget()
    source, used = NotedSource(SCENE), budget.used

    class Whim(DeviceScene):
        def _may_stay(self, rows: int) -> bool:
            return bool(rng.random() < 0.8)

    planes = SCENE.read(slice(0, SCENE.count), ["means", "sh_rest"])
    starts = list(range(0, SCENE.count, 64))
    with Whim(backend, SourcePlanes(backend, source), budget) as scene:
        scene.be_compact(100)
        for turn in range(12):
            stayed = set(scene._pinned)
            source.reads.clear()
            found = []
            for chunk in scene.chunks():
                if turn % 2:
                    (reclaim,) = budget.reclaimers
                    reclaim(int(rng.integers(0, 60_000)))
                rows = slice(chunk.base, chunk.base + chunk.count)
                for name, array in (("means", chunk.means), ("sh_rest", chunk.sh_rest)):
                    np.testing.assert_array_equal(backend.read(array)[:, : chunk.count], planes[name][:, rows])
                found.append(chunk.base)
            read = [rows.start for rows in source.reads if isinstance(rows, slice)]
            assert found == starts
            if turn % 2 == 0:
                assert read == [start for start in starts if start not in stayed]
            assert len(read) == len(set(read)) and len(scene._pinned) <= len(starts)
        for chunk in scene.chunks():  # left in the middle
            if chunk.base > SCENE.count // 2:
                break
    assert not budget.reclaimers and budget.used == used


def wide_scene() -> MemorySource:
    """Small splats along a curve, far wider than a view, a few large ones among them."""
    wide = joined(random_scene(2900, 7, 1, size=-3.0, spread=15.0), random_scene(12, 8, 1, size=0.0, spread=15.0))
    planes = wide.read(slice(0, wide.count), list(FIELD))
    order = near_rows(planes["means"])
    return MemorySource({name: values[:, order] for name, values in planes.items()})


@pytest.mark.parametrize(("form", "antialiased"), [("w8", False), ("w8", True), ("numpy", True)])
def test_views_read_the_chunks_that_they_see(form: str, antialiased: bool, compact: None, tmp_path: Path) -> None:
    source, views, counts = NotedSource(wide_scene()), cameras(), list[int]()

    def drawn(storage: ScratchStorage | None) -> list[np.ndarray]:
        drawer = Renderer(open_form(form), large_budget(), antialiased=antialiased)
        if storage is not None:
            drawer.storage = storage
        found = []
        with drawer.load(source) as scene:
            for camera in views:
                source.reads.clear()
                found.append(drawer.render(scene, camera))
                counts.append(len(source.reads))
                statistics = Statistics.zeros(source.count)
                drawer.add_statistics(scene, camera, statistics)
                found += [statistics.hits, statistics.weights]
        drawer.release()
        return found

    spilled = drawn(ScratchStorage(tmp_path))
    chunks = -(-source.count // 64)
    # The first view of the scene looks at every chunk, and the one that sees nothing at none.
    assert counts[0] >= chunks and counts[-1] == 0
    assert 0 < counts[1] < chunks and 0 < counts[2] < chunks, counts
    for values, expected in zip(spilled, drawn(None), strict=True):
        np.testing.assert_array_equal(values, expected)


def test_chunks_are_seen_where_any_of_their_splats_is() -> None:
    """Single rows, so that every bound is as tight as it can be; and what is left out is most of what shows nothing."""
    source = wide_scene()
    planes = source.read(slice(0, source.count), list(FIELD))
    single = [ChunkBounds.of(planes["means"][:, [i]], planes["log_scales"][:, [i]]) for i in range(source.count)]
    parts = (np.concatenate([getattr(one, name) for one in single], axis=-1) for name in ("middle", "half", "extent"))
    bounds = ChunkBounds(*parts)
    drawer = Renderer(open_form("numpy"), large_budget())
    with drawer.load(source) as scene:
        for camera in [cameras()[0], *cameras()]:
            drawer.render(scene, camera)
            scene._planes.bounds.clear()  # from the second view on, no block is left out
            if drawer.view_rows is not None:
                continue
            assert drawer._buffers is not None
            shown = np.asarray(drawer.backend.read(drawer._buffers.keys))[: source.count] != CULLED
            record = camera_record(camera, source.origin, drawer.near)
            seen = bounds.seen(record)
            assert not (shown & ~seen).any()
            assert (~seen).sum() > 0.7 * (~shown).sum()
    drawer.release()


def test_numbers_beyond_all_bounds_are_seen() -> None:
    record = camera_record(cameras()[-1], np.zeros(3), 0.2)  # the one that sees nothing
    means, scales = np.zeros((3, 2), np.float32), np.zeros((3, 2), np.float32)
    assert not ChunkBounds.of(means, scales).seen(record)
    scales[1, 1] = 1e4
    assert ChunkBounds.of(means, scales).extent == np.inf
    assert not ChunkBounds.of(means, scales).seen(record), "behind the camera, whatever the size"
    assert ChunkBounds.of(np.full((3, 2), np.nan, np.float32), scales).seen(record)
