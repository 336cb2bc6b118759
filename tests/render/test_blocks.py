"""Blocks of rows that a view cannot show are left out, and nothing else changes."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.harness import read_sums
from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.constants import ROW_BLOCK, SUM_LANES
from flexgs_edge.methods.best.costs import cost_parts, cost_sums, put_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original
from flexgs_edge.views.sums import ViewSums
from kernel_fixtures import FORMS, PairedBackend, large_budget, launch, open_form, same_bits
from synthetic import look_from, make_camera, random_scene

ROWS = 23 * ROW_BLOCK + 77


def wide_scene() -> MemorySource:
    """A cloud far wider than a view, neighbours in space near each other in row order."""
    wide = random_scene(ROWS, 7, 2, size=-3.0, spread=12.0)
    order = near_rows(wide.read(slice(0, ROWS), ["means"])["means"])
    return MemorySource({name: values[:, order] for name, values in wide.read(slice(0, ROWS), list(FIELD)).items()}, 2)


def views() -> list[Camera]:
    """Two views of a part, one of nearly all, one of nothing."""
    rotation, translation = look_from(3)
    away = np.diag([-1.0, 1.0, -1.0])
    return [
        make_camera(33, 20, translation=(6.0, 6.0, 0.0)),
        make_camera(33, 20, rotation=rotation, translation=translation),
        make_camera(45, 37, focal=4.0, translation=(0.0, 0.0, 3.0)),
        make_camera(33, 20, rotation=away),
    ]


def everything(form: str, antialiased: bool, blocks: bool) -> tuple[list[np.ndarray], list[int]]:
    """All that views and sums over them give, with the blocks of each view or with all of them; and rows by view."""
    renderer = Renderer(open_form(form), large_budget(), antialiased=antialiased)
    source, found, counts = wide_scene(), list[np.ndarray](), list[int]()
    statistics = Statistics.zeros(ROWS)
    with renderer.load(source, references=True) as scene:
        renderer.render(scene, views()[0])
        if not blocks:
            scene._planes.bounds.clear()
        for camera in views():
            found.append(renderer.render(scene, camera))
            renderer.add_statistics(scene, camera, statistics)
            assert renderer.parts is not None
            counts.append(sum(part.count for part in renderer.parts.values()))
            found.append(read_sums(renderer, renderer.removal_sums(scene, camera), 2, ROWS))
        sums = ViewSums(renderer, scene, [cost_sums(renderer, 2)])
        assert len(list(sums.draw("removal_sums", views()))) == 4
        parts = cost_parts(2, ROWS, renderer.storage)
        for rows, (costs,) in sums.parts():
            put_costs(parts, rows, costs)
        found += [parts.removal, parts.weight2, parts.moments]
        sums.release()
        references = [renderer.render_planes(scene, camera).astype(np.float16) for camera in views()]
    planes = source.read(slice(0, ROWS), list(FIELD))
    planes = {name: values + np.float32(0.1) if name.startswith("sh") else values for name, values in planes.items()}
    original = Original(renderer, np.zeros(3), views(), references)  # type: ignore[arg-type]
    moved = refit_colours(planes, np.full(ROWS, 2), original, rounds=1)
    renderer.release()
    return [*found, statistics.hits, statistics.weights, moved["sh_dc"], moved["sh_rest"]], counts


@pytest.mark.parametrize(
    ("form", "antialiased", "chunk_rows"),
    [
        ("w16", False, 1 << 18),
        ("w4", False, 2 * ROW_BLOCK + 64),
        ("gpu", False, 3 * ROW_BLOCK),
        ("w1", True, 640),
        ("numpy", True, 640),
    ],
)
def test_blocks_out_of_sight_make_no_difference(
    form: str, antialiased: bool, chunk_rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    use_fit(monkeypatch, chunk_rows=chunk_rows)
    some, counts = everything(form, antialiased, blocks=True)
    everything_else, all_counts = everything(form, antialiased, blocks=False)
    assert all_counts == [ROWS] * 4
    assert counts[3] == 0 < counts[0] < ROWS
    for one, other in zip(some, everything_else, strict=True):
        assert same_bits(one, other)


@pytest.mark.parametrize("form", FORMS)
def test_parts_of_views_on_kernels_and_twins(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    use_fit(monkeypatch, chunk_rows=3 * ROW_BLOCK, pairs=1 << 14)
    paired = PairedBackend(open_form(form), 2)
    renderer = Renderer(paired, large_budget())
    with renderer.load(wide_scene()) as scene:
        sums = ViewSums(renderer, scene, [cost_sums(renderer, 2)])
        assert len(list(sums.draw("removal_sums", views()[:2]))) == 2
        assert renderer.parts is not None
        assert 0 < sum(part.count for part in renderer.parts.values()) < ROWS
        sums.release()
    renderer.release()
    assert paired.launched["add_costs"] > 1


@pytest.mark.parametrize("form", ("w16", "w4", "w1", "gpu", "numpy"))
def test_costs_carry_into_their_high_words(form: str) -> None:
    """Sums near 2^64, added twice: the carry is counted, and rows beyond the part stay as they are."""
    sums = np.zeros((64, 2, 2), np.uint32)
    sums.view(np.uint64)[:, 0, 0] = 2**64 - 1 - np.arange(64, dtype=np.uint64)
    sums.view(np.uint64)[:, 1, 0] = 3
    costs = np.zeros((64 // SUM_LANES, 4, SUM_LANES), np.int64)
    blocks, camera, means = np.zeros(1, np.uint32), np.zeros(32, np.float32), np.zeros((3, 64), np.float32)
    for _ in range(2):
        *_, costs = launch(
            open_form(form), "add_costs", (64,), 50, 64, 0, 0, 0, 2, 0, blocks, camera, means, np.zeros((0, 64), np.float32),
            sums, costs,
        )  # fmt: skip
    low, high, weight, none = (costs[:, plane].reshape(-1)[:50].view(np.uint64).tolist() for plane in range(4))
    assert [h * 2**64 + low for h, low in zip(high, low, strict=True)] == [2 * (2**64 - 1 - k) for k in range(50)]
    assert weight == [6] * 50 and none == [0] * 50
    assert not costs[3, :, 2:].any()
