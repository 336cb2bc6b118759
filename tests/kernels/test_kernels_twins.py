"""Every kernel against its twin, to the last bit, launch by launch, as the renderer drives them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.harness import read_sums
from fits import use_fit
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.kernels.backend import KERNELS
from flexgs_edge.kernels.twins import TWINS
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original
from kernel_fixtures import (
    FORMS,
    PairedBackend,
    count,
    draw,
    large_budget,
    launch,
    open_form,
    removal_costs,
    residual_sums,
    same_bits,
)
from quantized_scenes import quantize_all
from synthetic import SIZES, joined, look_from, make_camera, random_scene

COUNTS = (0, 1, 15, 16, 17, 63, 64, 65, 2049)


@pytest.fixture(autouse=True)
def _small_pair_buffer(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every launch compares every array: 32 MB of pairs would be most of it."""
    use_fit(monkeypatch, pairs=1 << 14)


def test_every_kernel_has_a_twin() -> None:
    assert set(TWINS) == set(KERNELS)


@pytest.mark.parametrize("rows", COUNTS)
@pytest.mark.parametrize("form", FORMS)
def test_whole_views(form: str, rows: int) -> None:
    paired = PairedBackend(open_form(form), 3)
    rotation, translation = look_from(rows)
    camera = make_camera(45, 37, rotation=rotation, translation=translation)
    scene = random_scene(rows, 1, rows % 5, size=-3 if rows > 100 else -2)
    image = draw(paired, scene, camera, background=(0.1, 0.5, 1.0))
    statistics = count(paired, scene, [camera, make_camera(45, 37)])
    assert np.isfinite(image).all()
    assert statistics.hits.any() == (rows > 0)
    assert paired.launched["blend"] == 1 and paired.launched["blend_stats"] == 2


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("size", SIZES)
def test_image_sizes(form: str, size: tuple[int, int]) -> None:
    paired = PairedBackend(open_form(form), 2)
    camera = make_camera(*size, focal=20)
    assert draw(paired, random_scene(50, 2, 1), camera).shape == (size[1], size[0], 3)
    assert count(paired, random_scene(50, 2, 1), [camera]).hits.any()


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("blocks", [1, 2, 16, 64])
def test_blocks_of_the_serial_passes(form: str, blocks: int) -> None:
    draw(PairedBackend(open_form(form), blocks), random_scene(33, 4), make_camera(33, 20))


@pytest.mark.parametrize("form", FORMS)
def test_batches(form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """A pair buffer as small as it can be: colour and transmittance are carried from batch to batch."""
    use_fit(monkeypatch, pairs=1)
    paired = PairedBackend(open_form(form), 3)
    draw(paired, random_scene(60, 5), make_camera(45, 37))
    count(paired, random_scene(60, 5), [make_camera(45, 37)])
    assert paired.launched["blend"] > 3 and paired.launched["blend_stats"] > 3


@pytest.mark.parametrize("form", FORMS)
def test_nothing_is_read_before_it_is_written(form: str) -> None:
    """What new arrays hold makes no difference: zeros, ones, or the bits of NaN."""
    images, hits = [], []
    for pattern in (0x00, 0x3F, 0xFF):
        paired = PairedBackend(open_form(form), 3, pattern)
        images.append(draw(paired, random_scene(37, 22, 2), make_camera(37, 20)))
        hits.append(count(paired, random_scene(37, 22, 2), [make_camera(37, 20)]))
    for image, statistics in zip(images[1:], hits[1:]):
        assert same_bits(image, images[0])
        assert same_bits(statistics.hits, hits[0].hits) and same_bits(statistics.weights, hits[0].weights)


def strange_scene() -> MemorySource:
    """Rows that the checks of a reader would refuse, and rows at the ends of float32, beside ordinary ones."""
    base = random_scene(64, 6, 2)
    arrays = base.read(slice(0, 64), list(FIELD))
    tame = arrays["log_scales"].copy()
    arrays["means"][:, 0] = np.nan
    arrays["means"][2, 1] = np.inf
    arrays["means"][0, 2] = -np.inf
    arrays["log_scales"][:, 3] = np.nan
    arrays["log_scales"][1, 4] = -np.inf
    arrays["log_scales"][:, 5] = 80
    arrays["log_scales"][0, 6] = 30
    arrays["log_scales"][:, 7] = -80
    arrays["log_scales"][:, 8] = (2, -20, -20)
    arrays["quats"][:, 9] = 0
    arrays["quats"][:, 10] = (1e-30, 2e-30, 0, -1e-30)
    arrays["quats"][:, 11] = (1e30, 2e30, 0, -1e30)
    arrays["quats"][1, 12] = np.nan
    arrays["opacity_logits"][0, 13:18] = (100, -100, np.inf, -np.inf, np.nan)
    arrays["sh_dc"][0, 18:21] = (np.nan, 1e38, -np.inf)
    arrays["means"][:2, 21:26] = 0
    arrays["means"][2, 21:26] = (-4, 0, 0.2, np.nextafter(np.float32(0.2), np.float32(1)), 1e30)
    arrays["means"][0, 26:28] = (1e6, -1e30)
    arrays["log_scales"][:, 28] = (5, 5, 5)
    arrays["log_scales"][:, 21:28] = tame[:, 21:28]
    arrays["means"][:, 29], arrays["quats"][:, 29], arrays["log_scales"][:, 29] = (0, 0, 4), (1, 0, 0, 0), 25
    return MemorySource(arrays, 2)


@pytest.mark.parametrize("form", FORMS)
def test_strange_values(form: str) -> None:
    paired = PairedBackend(open_form(form), 3)
    draw(paired, strange_scene(), make_camera(40, 24))
    statistics = count(paired, strange_scene(), [make_camera(40, 24)])
    culled = [0, 1, 3, 5, 9, 12, 14, 16, 17, 21, 22, 23, 29]
    assert not statistics.hits[culled].any()
    assert statistics.hits[[10, 11, 13, 15]].any()


@pytest.mark.parametrize("payload", [0x7FC00000, 0xFFC00000, 0x7FC00001, 0xFFFFFFFF])
@pytest.mark.parametrize("form", FORMS)
def test_invalid_rows_leave_no_trace(form: str, payload: int) -> None:
    """An image with NaN rows in the scene is the image without them, and has no NaN."""
    arrays = random_scene(40, 7).read(slice(0, 40), list(FIELD))
    for row, name in enumerate(("means", "log_scales", "quats", "opacity_logits")):
        arrays[name][:, 5 * row] = np.array(payload, np.uint32).view(np.float32)
    broken = MemorySource(arrays)
    kept = np.delete(np.arange(40), [0, 5, 10, 15])
    camera = make_camera(33, 33)
    image = draw(open_form(form), broken, camera)
    assert np.isfinite(image).all()
    assert same_bits(image, draw(open_form(form), broken.select(kept), camera))


def padded_target(camera: Camera, seed: int) -> np.ndarray:
    shape = (3, -(-camera.height // 16) * 16, -(-camera.width // 16) * 16)
    return np.random.default_rng(seed).uniform(0, 1, shape).astype(np.float16)


@pytest.mark.parametrize("pairs", [1 << 12, 1])
@pytest.mark.parametrize("form", FORMS)
def test_removal_costs_and_residuals(form: str, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Second passes over the same lists, in one batch and in many."""
    use_fit(monkeypatch, pairs=pairs)
    paired = PairedBackend(open_form(form), 3)
    camera, source = make_camera(45, 37), random_scene(60, 18, 1)
    errors, weights = removal_costs(paired, source, camera, (0.1, 0.5, 1.0))
    assert (errors > 0).sum() > 40 and (weights > 0).sum() == (errors > 0).sum()
    sums = residual_sums(paired, source, camera, padded_target(camera, 19))
    assert (sums[0] > 0).sum() > 40 and (sums[1:] < 0).any() and (sums[1:] > 0).any()
    assert paired.launched["blend_removal"] == paired.launched["blend_residual"] >= 1
    renderer = Renderer(paired, large_budget(), background=(0.1, 0.5, 1.0))
    with renderer.load(source) as scene:
        both = read_sums(
            renderer, renderer.residual_and_removal_sums(scene, camera, padded_target(camera, 19)), 6, source.count
        )
        apart = read_sums(renderer, renderer.removal_sums(scene, camera), 2, source.count)
        assert (both[4:] == apart).all() and (both[1:4] != 0).any()
        apart = read_sums(renderer, renderer.residual_sums(scene, camera, padded_target(camera, 19)), 4, source.count)
        assert (both[:4] == apart).all()
    renderer.release()


@pytest.mark.parametrize("rows", [1, 17, 65])
@pytest.mark.parametrize("degree", range(1, 5))
@pytest.mark.parametrize("form", FORMS)
def test_moments_of_sh(form: str, degree: int, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Costs of dropping SH degrees and sums of the colour refit, over two views and two chunks."""
    use_fit(monkeypatch, chunk_rows=40)
    paired = PairedBackend(open_form(form), 2)
    rotation, translation = look_from(20)
    views = [make_camera(33, 20), make_camera(33, 20, rotation=rotation, translation=translation)]
    source = random_scene(rows, 20, degree, size=-1.5)
    renderer = Renderer(paired, large_budget())
    with renderer.load(source) as scene:
        costs = measure_costs(renderer, scene, views)
    assert costs.sh.shape == (degree, rows) and costs.sh.any()
    planes = source.read(slice(0, rows), list(FIELD))
    references = [padded_target(camera, degree) for camera in views]
    original = Original(renderer, np.zeros(3), views, references)  # type: ignore[arg-type]
    refit_colours(planes, np.full(rows, degree), original, rounds=1)
    renderer.release()
    assert paired.launched["add_costs"] and paired.launched["sh_residual"]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("bits", range(1, 17))
def test_dequantized_scenes(form: str, bits: int) -> None:
    """Codes of every width on the way to an image; odd counts, a block without SH."""
    paired = PairedBackend(open_form(form), 3)
    scene = joined(random_scene(67, bits, 1), random_scene(66, bits, 1))
    quantized = quantize_all(scene, BitSpec(*(bits,) * 6), groups=5)
    renderer = Renderer(paired, large_budget())
    with renderer.load_quantized(quantized) as loaded:
        renderer.render(loaded, make_camera(20, 20))
    renderer.release()
    assert paired.launched["dequantize"] > 5


@pytest.mark.parametrize("form", FORMS)
def test_equal_keys_keep_their_order(form: str) -> None:
    """Sorting passes alone, on keys with many ties: rows of equal depth come out ascending."""
    rng = np.random.default_rng(8)
    for rows, blocks in ((1, 1), (65, 3), (2049, 7)):
        keys = rng.choice(np.array([5, 1 << 12, 1 << 30, 0x3F800000, 0xFFFFFFFF], np.uint32), rows)
        order = sort_by_passes(form, keys, blocks)
        shown = np.flatnonzero(keys != 0xFFFFFFFF)
        np.testing.assert_array_equal(order, shown[np.argsort(keys[shown], kind="stable")])


@pytest.mark.parametrize("rows", (*COUNTS[1:], 5000))
@pytest.mark.parametrize("form", FORMS)
def test_sorted_order(form: str, rows: int) -> None:
    keys = np.random.default_rng(rows).integers(0, 2**31, rows, dtype=np.uint32)
    np.testing.assert_array_equal(sort_by_passes(form, keys, 5), np.argsort(keys, kind="stable"))


def sort_by_passes(form: str, keys: np.ndarray, blocks: int) -> np.ndarray:
    """Rows of the shown keys in order, by the sort kernels as the renderer calls them."""
    backend = open_form(form)
    rows, cells = keys.size, 2048 * blocks
    bounds, sums = np.ones(rows, np.uint32), np.zeros(blocks, np.uint64)
    empty = np.zeros(rows, np.uint32)
    *_, digits, sums = launch(
        backend, "sort_count_first", (blocks,), rows, keys, bounds, np.zeros(cells + 1, np.uint32), sums
    )
    assert sums.sum() == (keys != 0xFFFFFFFF).sum()
    (digits,) = launch(backend, "exclusive_scan", (1,), 2048, blocks, digits)
    shown = int(digits[cells])
    *_, keys, ids = launch(backend, "sort_scatter_first", (blocks,), rows, keys, digits, empty, empty)
    for shift in (11, 22):
        _, digits = launch(backend, "sort_count", (blocks,), shown, shift, keys, digits)
        (digits,) = launch(backend, "exclusive_scan", (1,), 2048, blocks, digits)
        *_, keys, ids = launch(backend, "sort_scatter", (blocks,), shown, shift, keys, ids, digits, empty, empty)
    return ids[:shown]


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize(("cells", "blocks"), [(1, 1), (15, 3), (16, 16), (2049, 2)])
def test_exclusive_scan(form: str, cells: int, blocks: int) -> None:
    """Cell by cell, and block by block within a cell; the total at the end."""
    values = np.random.default_rng(cells).integers(0, 1000, blocks * cells + 1).astype(np.uint32)
    (scanned,) = launch(open_form(form), "exclusive_scan", (1,), cells, blocks, values)
    sums = np.concatenate([[0], np.cumsum(values[:-1].reshape(blocks, cells).T.reshape(-1))])
    np.testing.assert_array_equal(scanned[:-1].reshape(blocks, cells).T.reshape(-1), sums[:-1])
    assert scanned[-1] == sums[-1]


@pytest.mark.parametrize("form", FORMS)
def test_sums_beyond_32_bits(form: str) -> None:
    """One splat over 48x48 pixels in 9 tiles: its weights carry into the high word, the same on kernel and twin."""
    scene = random_scene(3, 9, size=math.log(30.0), opacity=8)
    statistics = count(PairedBackend(open_form(form), 1), scene, [make_camera(48, 48)] * 3)
    assert statistics.weights.max() > 2**33


@pytest.mark.parametrize("form", FORMS)
def test_antialiased_views(form: str) -> None:
    """Opacity compensation: ordinary rows, needles, splats flat to the last bit, and rows at the ends of float32."""
    paired = PairedBackend(open_form(form), 3)
    rotation, translation = look_from(23)
    camera = make_camera(45, 37, rotation=rotation, translation=translation)
    arrays = random_scene(200, 23, 1).read(slice(0, 200), list(FIELD))
    arrays["log_scales"][0] += 2
    arrays["log_scales"][2, 50:150] = -87
    arrays["log_scales"][1, 100:150] = -12
    arrays["quats"][:, 50:110:3] = np.array([[1], [0], [1], [0]])
    for source in (MemorySource(arrays, 1), strange_scene(), random_scene(17, 24)):
        assert draw(paired, source, camera, antialiased=True).any()
        assert count(paired, source, [camera, make_camera(40, 24)], antialiased=True).hits.any()
