"""Measured costs against their definitions: remove a Gaussian and render again, drop SH and compare colours, fox's goldens."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from benchmarks.harness import read_sums
from benchmarks.removal_exactness import compare_in_float64, kernels_without_ending, spread_over_range
from fits import use_fit
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.constants import FIXED_ERROR, SH_C0, TRANSMITTANCE_MIN
from flexgs_edge.io.ply import PlySource
from flexgs_edge.kernels.backend import Backend, TwinBackend
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.twins.project import sh_basis
from flexgs_edge.methods.best.costs import RemovalCosts, measure_costs
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from kernel_fixtures import FORMS, default_device, large_budget, open_form, same_bits
from synthetic import look_from, make_camera, random_scene


def poses(views: int, width: int = 45, height: int = 37) -> list[Camera]:
    """Poses around the middle of `random_scene`."""
    cameras = []
    for seed in range(views):
        rotation, translation = look_from(seed)
        cameras.append(make_camera(width, height, rotation=rotation, translation=translation))
    return cameras


@pytest.fixture
def no_ending(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Callable[[], Backend]]:
    """Opens a backend whose pixels never end."""
    monkeypatch.setenv("FLEXGS_KERNEL_DIR", str(kernels_without_ending(tmp_path / "kernels")))
    opened: list[Backend] = []

    def open_one(form: str) -> Backend:
        if form == "numpy":
            monkeypatch.setattr(sys.modules["flexgs_edge.kernels.twins.blend"], "TRANSMITTANCE_MIN", 0.0)
            backend: Backend = TwinBackend(large_budget())
        else:
            backend = OpenCLBackend(default_device(), large_budget())
        opened.append(backend)
        return backend

    yield open_one  # type: ignore[misc]
    for backend in opened:
        backend.close()


PIXEL_NOISE = 2e-7
"""Rounding of a float32 render: its difference from the image without one Gaussian is off by about so much in every value."""


@dataclass
class Removed:
    """Errors of removing single rows: from one scoring pass, from renders with and without, and what rounding explains."""

    measured: np.ndarray
    rendered: np.ndarray
    noise: np.ndarray

    @property
    def beyond_noise(self) -> np.ndarray:
        """Relative difference that rounding of the renders does not explain."""
        difference = np.maximum(abs(self.measured - self.rendered) - self.noise, 0)
        return difference / np.maximum(self.rendered, 1e-30)


@contextmanager
def without(scene: DeviceScene, row: int) -> Iterator[None]:
    """The scene without one row: its opacity is below what any view shows."""
    (chunk,) = scene.chunks()
    before = scene.backend.read(chunk.log2_opacity, np.empty(1, np.float32), row)
    scene.backend.write(chunk.log2_opacity, np.full(1, -1e3, np.float32), row)
    yield
    scene.backend.write(chunk.log2_opacity, before, row)


def exactness(backend: Backend, source: SceneSource, cameras: list[Camera], rows: np.ndarray) -> Removed:
    """Remove each of `rows` alone and render again."""
    renderer = Renderer(backend, large_budget(), background=(0.3, 0.1, 0.6))
    measured, rendered, noise = (np.zeros(len(rows)) for _ in range(3))
    with renderer.load(source) as scene:
        for camera in cameras:
            sums = read_sums(renderer, renderer.removal_sums(scene, camera), 2, scene.count)
            measured += sums[0][rows] / FIXED_ERROR
            whole = renderer.render(scene, camera).astype(np.float64)
            for place, row in enumerate(rows):
                with without(scene, int(row)):
                    difference = abs(renderer.render(scene, camera) - whole)
                rendered[place] += np.vdot(difference, difference)
                # The square of difference plus rounding, with every rounding of one sign: a bound.
                touched = difference[difference > 0]
                noise[place] += 2 * PIXEL_NOISE * touched.sum() + touched.size * PIXEL_NOISE**2
    renderer.release()
    return Removed(measured, rendered, noise)


@pytest.mark.parametrize("form", ["w16", "numpy"])
@pytest.mark.parametrize(("count", "opacity"), [(1, 0.0), (60, 0.0), (250, 1.5)])
def test_removal_is_exact_where_pixels_do_not_end(no_ending, form: str, count: int, opacity: float) -> None:  # type: ignore[no-untyped-def]
    source = random_scene(count, 31, 1, size=-1.6, opacity=opacity)
    rows = np.arange(count) if count <= 60 else np.arange(0, count, 6)
    if form == "numpy":
        rows = rows[::8]
    found = exactness(no_ending(form), source, poses(2), rows)
    assert (found.rendered > 0).sum() >= 0.6 * len(rows)
    unseen = found.measured == 0
    assert (found.rendered[unseen] <= found.noise[unseen]).all()
    assert (found.beyond_noise <= 1e-4).all(), found.beyond_noise.max()


def test_removal_is_exact_with_faint_splats_on_the_ordinary_kernels() -> None:
    """25 splats with an opacity of at most .25: transmittance stays above 1e-4 (.75^25 = 7.5e-4), so nothing ends early."""
    source = random_scene(25, 32, 2, size=-1.0)
    planes = source.read(slice(0, 25), list(FIELD))
    planes["opacity_logits"] = np.random.default_rng(3).uniform(-4, -1.1, (1, 25)).astype(np.float32)
    found = exactness(open_form("w16"), MemorySource(planes, 2), poses(2), np.arange(25))
    assert (found.rendered > 0).sum() > 15 and (found.beyond_noise <= 1e-4).all()


def test_ending_pixels_change_what_little_they_may(no_ending) -> None:  # type: ignore[no-untyped-def]
    """Dense opaque splats: removing one lets others be blended that were behind the end. Frozen hits leave that out."""
    source = random_scene(250, 33, size=-1.0, opacity=3.0)
    rows = np.arange(0, 250, 5)
    exact = exactness(no_ending("w16"), source, poses(2), rows)
    ended = exactness(open_form("w16"), source, poses(2), rows)
    assert (exact.beyond_noise <= 1e-4).all()
    seen = ended.rendered > 1e-6
    share = float((ended.beyond_noise[seen] > 0.01).mean())
    print(f"with ending on {share:.0%} of {seen.sum()} Gaussians are off by more than 1 %")
    # The costs themselves barely know of the end: what lies behind it shines through with 1e-4.
    assert share <= 0.3
    assert abs(ended.measured[seen].sum() / ended.rendered[seen].sum() - 1) < 0.01


def test_sample_removals_against_renders(no_ending, sample_dir: Path) -> None:  # type: ignore[no-untyped-def]
    """20 Gaussians across the whole range of costs, on two poses of a trained scene."""
    source, cameras = PlySource(sample_dir / "point_cloud.ply"), read_cameras(sample_dir / "cameras.json")[3:60:30]
    rows = np.zeros(0, np.int64)
    for backend, least in ((open_form("w16"), TRANSMITTANCE_MIN), (no_ending("w16"), 0.0)):
        renderer = Renderer(backend, large_budget())
        with renderer.load(source) as scene:
            if least:
                costs = measure_costs(renderer, scene, cameras, sh_costs=False).removal
                rows = spread_over_range(np.where(costs > 1e-8, costs, 0), 20, seed=5)
            found = compare_in_float64(renderer, scene, cameras, rows, least)
        renderer.release()
        assert found.measured.max() > 1e8 * found.measured.min() > 0
        off = int((found.relative > 0.01).sum())
        if least:
            np.testing.assert_allclose(found.measured, costs[rows], rtol=1e-9)
            print(f"with ending on {off} of 20 are off by more than 1 %")
            assert off <= 7
        else:
            # Deep behind others, rounding of the image behind to float32 shows.
            shown = found.relative[found.rendered > 1e-5]
            assert (shown <= 1e-3).all() and np.mean(shown <= 1e-4) >= 0.8 and off <= 1, found


def costs_of(backend: Backend, source: SceneSource, cameras: list[Camera], sh_costs: bool = True) -> RemovalCosts:
    renderer = Renderer(backend, large_budget())
    with renderer.load(source) as scene:
        costs = measure_costs(renderer, scene, cameras, sh_costs)
    renderer.release()
    return costs


def sh_costs_by_formula(
    source: SceneSource, cameras: list[Camera], weight2: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """sum_v w2_v |d_v - m|^2 and m for each lower degree, from `weight2` ([views, N]) in float64."""
    planes = source.read(slice(0, source.count), ["means", "sh_rest"])
    degree, count = source.sh_degree, source.count
    rest = planes["sh_rest"].astype(np.float64).reshape(3, -1, count)
    costs, means = np.zeros((degree, count)), np.zeros((degree, 3, count))
    offsets = np.zeros((degree, len(cameras), 3, count))
    for view, camera in enumerate(cameras):
        direction = planes["means"].astype(np.float64) - camera.moved(source.origin).center[:, None]
        direction /= np.linalg.norm(direction, axis=0)
        basis = np.stack(sh_basis(degree, *direction.astype(np.float32))).astype(np.float64)
        for level in range(degree):
            first = (level + 1) ** 2 - 1
            offsets[level, view] = np.einsum("kn,ckn->cn", basis[first:], rest[:, first:])
    total = weight2.sum(axis=0)
    for level in range(degree):
        d = offsets[level]
        means[level] = (weight2[:, None] * d).sum(axis=0) / np.where(total > 0, total, 1)
        costs[level] = (weight2[:, None] * (d - means[level]) ** 2).sum(axis=(0, 1))
    return costs, means


@pytest.mark.parametrize("degree", [1, 2, 3, 4])
def test_sh_costs_are_the_weighted_variance_of_the_colour(degree: int) -> None:
    source = random_scene(70, 34, degree, size=-1.6, origin=(3.0, -2.0, 1.0))
    moved = [Camera(c.name, c.width, c.height, c.rotation, c.translation - c.rotation @ source.origin, c.fx, c.fy, c.cx, c.cy)
             for c in poses(5)]  # fmt: skip
    backend = open_form("w16")
    by_view = np.stack([costs_of(backend, source, [camera], sh_costs=False).weight2 for camera in moved])
    costs = costs_of(backend, source, moved)
    np.testing.assert_allclose(costs.weight2, by_view.sum(axis=0), rtol=1e-12)
    expected, mean = sh_costs_by_formula(source, moved, by_view)
    seen = costs.weight2 > 0
    assert costs.sh.shape == (degree, 70) and seen.sum() > 40
    # Relative to the squares that the mean's is taken from; and 2^-32 for each of the sums' roundings.
    squares = expected + costs.weight2 * (mean**2).sum(axis=1)
    assert (abs(costs.sh - expected) <= 1e-5 * squares + 40 * 2.0**-32)[:, seen].all()
    np.testing.assert_allclose(costs.sh_mean[:, :, seen], mean[:, :, seen], atol=2e-5)
    assert (costs.sh[:, ~seen] == 0).all() and (costs.sh_mean[:, :, ~seen] == 0).all()
    # More bands dropped, and no less lost.
    assert (costs.sh[1:] <= costs.sh[:-1]).sum() >= 0.5 * costs.sh[1:].size


def test_sh_cost_is_what_a_render_loses_where_one_splat_is_alone() -> None:
    """A single splat: dropping its SH, with the mean in the constant, costs exactly the squared error of the images."""
    source = random_scene(1, 35, 2, size=-0.8, opacity=1.0, spread=0.2)
    planes = source.read(slice(0, 1), list(FIELD))
    planes["sh_dc"][:] = 1.5  # bright enough that no colour is cut off at zero
    source, cameras = MemorySource(planes, 2), poses(4)
    backend = open_form("w16")
    costs = costs_of(backend, source, cameras)
    for level in range(2):
        lower = {**planes, "sh_dc": planes["sh_dc"] + costs.sh_mean[level] / np.float32(SH_C0)}
        lower["sh_rest"] = planes["sh_rest"].copy().reshape(3, 8, 1)
        lower["sh_rest"][:, (level + 1) ** 2 - 1 :] = 0
        lower["sh_rest"] = lower["sh_rest"].reshape(24, 1)
        renderer, lost = Renderer(backend, large_budget()), 0.0
        images = []
        for one in (source, MemorySource(lower, 2)):
            with renderer.load(one) as scene:
                images.append([renderer.render(scene, camera).astype(np.float64) for camera in cameras])
        lost = sum(float(((a - b) ** 2).sum()) for a, b in zip(*images, strict=True))
        assert costs.sh[level, 0] == pytest.approx(lost, rel=1e-4) and lost > 0


def test_sums_go_beyond_64_bits() -> None:
    """A splat that is as bright as a view can count, in front of many poses."""
    source = random_scene(3, 37, size=0.0, opacity=2.0)
    planes = source.read(slice(0, 3), list(FIELD))
    planes["sh_dc"][:] = [[1e5, 1.0, 1.0]]
    source, cameras = MemorySource(planes), poses(12)
    backend = open_form("w16")
    costs = costs_of(backend, source, cameras)
    renderer, expected = Renderer(backend, large_budget()), [0, 0, 0]
    with renderer.load(source) as scene:
        for camera in cameras:
            removal = read_sums(renderer, renderer.removal_sums(scene, camera), 2, scene.count)[0]
            expected = [old + more for old, more in zip(expected, removal.tolist(), strict=True)]
    assert max(expected) > 2**64
    assert costs.removal == pytest.approx(np.array(expected, np.float64) / FIXED_ERROR, rel=1e-12)
    assert np.array_equal(costs_of(open_form("numpy"), source, cameras).removal, costs.removal)


def test_nothing_is_measured_of_nothing() -> None:
    for count in (0, 1):
        costs = costs_of(open_form("w16"), random_scene(count, 36, 1), [])
        assert costs.removal.shape == costs.weight2.shape == (count,) and not costs.weight2.any()
        assert costs.sh.shape[1:] == (count,) and costs.sh_mean.shape[1:] == (3, count) and not costs.sh.any()
    behind = make_camera(33, 20, translation=(0.0, 0.0, -50.0))
    costs = costs_of(open_form("w16"), random_scene(7, 36, 2), [behind])
    assert not costs.removal.any() and not costs.sh.any() and not costs.sh_mean.any()


@pytest.mark.parametrize("pairs", [1 << 14, 1])
@pytest.mark.parametrize("degree", [0, 1, 4])
def test_every_form_measures_the_same_bits(degree: int, pairs: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Vector widths, the GPU form and the twins, in one batch and in many, on an odd image."""
    use_fit(monkeypatch, pairs=pairs)
    source, cameras = random_scene(77, 37, degree, size=-1.8), poses(2, 33, 19)
    expected = costs_of(open_form("numpy"), source, cameras)
    assert expected.removal.any() and expected.sh.any() == (degree > 0)
    for form in FORMS:
        assert_same(costs_of(open_form(form), source, cameras), expected)


def assert_same(one: RemovalCosts, two: RemovalCosts) -> None:
    for name in ("removal", "weight2", "sh", "sh_mean"):
        assert same_bits(getattr(one, name), getattr(two, name)), name


@pytest.mark.parametrize("rows", [7, 64, 100])
@pytest.mark.parametrize("form", ["w16", "w1", "gpu", "numpy"])
def test_chunks_change_nothing(form: str, rows: int, monkeypatch: pytest.MonkeyPatch) -> None:
    source, cameras = random_scene(128, 38, 3, size=-1.8), poses(2, 17, 33)
    whole = costs_of(open_form(form), source, cameras)
    use_fit(monkeypatch, chunk_rows=rows)
    assert_same(costs_of(open_form(form), source, cameras), whole)


def test_a_scene_that_is_streamed_costs_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    """Chunks that are loaded again for every view: the moments stay with their rows."""
    source, cameras = random_scene(300, 40, 3, size=-2), poses(3, 33, 17)
    whole = costs_of(open_form("w16"), source, cameras)
    use_fit(monkeypatch, resident=False, chunk_rows=128, least_rows=128)
    assert_same(costs_of(open_form("w16"), source, cameras), whole)


def test_order_of_the_poses_changes_nothing() -> None:
    source, cameras = random_scene(90, 39, 2, size=-1.5), poses(4)
    assert_same(costs_of(open_form("w16"), source, cameras[::-1]), costs_of(open_form("w16"), source, cameras))


@pytest.fixture(scope="module")
def fox_costs(fox_dir: Path) -> RemovalCosts:
    """The scoring pass over the 43 training poses: once, 4 s."""
    cameras = read_cameras(fox_dir / "cameras.json")
    train, _ = split_views(len(cameras))
    return costs_of(open_form("w16"), PlySource(fox_dir / "point_cloud.ply"), [cameras[i] for i in train])


def close(found: np.ndarray, expected: np.ndarray, above: float, share: float, tolerance: float) -> bool:
    """Sums within 1e-4, and that share of the entries above a floor within the tolerance."""
    expected = expected.astype(np.float64)
    seen = expected > above
    assert seen.mean() > 0.5
    near = abs(np.log(np.maximum(found[seen], 1e-30) / expected[seen])) <= tolerance
    return bool(abs(found.sum() / expected.sum() - 1) <= 1e-4 and near.mean() >= share)


def test_fox_costs_against_an_independent_renderer(fox_costs: RemovalCosts, fox_dir: Path) -> None:
    with np.load(fox_dir / "golden.npz") as golden, np.load(fox_dir / "golden_costs.npz") as costs:
        assert close(fox_costs.removal, golden["dse_train"], 1e-5, 0.999, 0.01)
        assert close(fox_costs.weight2, costs["w2_train"], 1e-4, 0.999, 1e-3)
        assert close(fox_costs.sh[0], costs["sh0_cost_train"], 1e-5, 0.998, 0.01)
        mean, seen = costs["sh0_mean_train"].T, fox_costs.weight2 > 1e-3
        assert (abs(fox_costs.sh_mean[0] - mean)[:, seen] <= 1e-4 + 1e-3 * abs(mean[:, seen])).mean() >= 0.999
    assert (fox_costs.sh[1:] <= 1.001 * fox_costs.sh[:-1] + 1e-9).mean() > 0.9


def test_fox_costs_rank_what_goes_first(fox_costs: RemovalCosts) -> None:
    """Units: what removal costs is below three channels times the weights at full contrast, with slack for bright colours."""
    seen = fox_costs.weight2 > 0
    assert 0.9 < seen.mean() <= 1 and (fox_costs.removal[~seen] == 0).all()
    assert fox_costs.removal.min() >= 0 and np.isfinite(fox_costs.removal).all()
    assert FIXED_ERROR == 2.0**40
