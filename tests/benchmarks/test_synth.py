"""`benchmarks.synth`: exact counts, the same bytes however it is cut, a look that stays, and cameras."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from benchmarks.parts import ACROSS, ALONG, MOST_PARTS, OFFSET, PartsSource, half_logits
from benchmarks.synth import synth, tile_shifts, tiled_cameras
from camera_files import write_inria
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.quality.psnr import psnr
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.rotations import turned
from flexgs_edge.scene.source import MemorySource, SceneSource
from scene_files import open_scene
from synthetic import make_camera, random_scene

ALL = [field.name for field in FIELDS]
ONE = np.zeros((1, 3))


def everything(source: SceneSource) -> dict[str, np.ndarray]:
    return source.read(slice(0, source.count), ALL)


def sources_of(made: SceneSource, parent: SceneSource) -> np.ndarray:
    """Which of the parent's Gaussians each row comes from, told by its rotation."""
    quats = parent.read(slice(0, parent.count), ["quats"])["quats"].T
    known = {quat.tobytes(): row for row, quat in enumerate(np.ascontiguousarray(quats))}
    rows = np.ascontiguousarray(made.read(slice(0, made.count), ["quats"])["quats"].T)
    return np.array([known[quat.tobytes()] for quat in rows])


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """A small scene with cameras in a folder of its own."""
    folder = tmp_path / "scene"
    folder.mkdir()
    write_ply(folder / "point_cloud.ply", random_scene(300, degree=1))
    write_inria(folder / "cameras.json", [make_camera(name=f"view_{i}") for i in range(3)])
    (tmp_path / "out").mkdir()
    return folder / "point_cloud.ply"


@pytest.mark.parametrize("count", [100, 101, 199, 200, 250, 333, 799])
@pytest.mark.parametrize("seed", [0, 7])
def test_rows_are_dealt_out_evenly(count: int, seed: int) -> None:
    parent = random_scene(100, degree=1)
    made = PartsSource(parent, count, ONE, seed)
    shares = np.bincount(sources_of(made, parent), minlength=100)
    assert shares.sum() == count
    assert {*shares} <= {count // 100, -(-count // 100)}


def test_any_reading_gives_the_same_bits(tmp_path: Path) -> None:
    parent = random_scene(97, degree=2)
    made = PartsSource(parent, 97 * 5 + 31, np.array([[0, 0, 0], [3.0, 0, 1]]), seed=3)
    whole = everything(made)
    rows = np.sort(np.random.default_rng(0).choice(made.count, 200, replace=False))
    for name in ALL:  # one field alone, some rows alone
        assert np.array_equal(made.read(rows, [name])[name], whole[name][:, rows]), name
    assert made.read(np.array([], np.int64), ["means"])["means"].shape == (3, 0)
    files = []
    for chunk in (1, 7, 100, 65536):
        write_ply(tmp_path / f"{chunk}.ply", made, chunk_rows=chunk)
        files.append((tmp_path / f"{chunk}.ply").read_bytes())
    assert len({*files}) == 1


def test_the_seed_chooses_who_gets_more() -> None:
    parent = random_scene(100)
    first, again, other = (sources_of(PartsSource(parent, 150, ONE, seed), parent) for seed in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_as_many_as_there_are_is_a_copy() -> None:
    parent = random_scene(50, degree=3)
    made, original = everything(PartsSource(parent, 50, ONE)), everything(parent)
    for name in ALL:
        assert np.array_equal(made[name], original[name]), name


def test_two_halves_keep_the_middle_and_the_second_moment() -> None:
    parent = random_scene(200, degree=1)
    one, two = everything(parent), everything(PartsSource(parent, 400, ONE))
    first, second = ({name: values[:, i::2].astype(np.float64) for name, values in two.items()} for i in (0, 1))
    longest, column = one["log_scales"].argmax(axis=0), np.arange(200)
    scales = np.exp(one["log_scales"].astype(np.float64))
    middle = (first["means"] + second["means"]) / 2
    assert np.allclose(middle, one["means"], atol=1e-6)
    axis = np.zeros((3, 200))
    axis[longest, column] = 1
    along = turned(one["quats"], axis)
    half_way = (second["means"] - first["means"]) / 2
    assert np.allclose(half_way, along * scales[longest, column] * OFFSET, atol=1e-5)
    for half in (first, second):
        ratio = np.exp(half["log_scales"]) / scales
        assert np.allclose(ratio[longest, column] ** 2 + OFFSET**2, 1, atol=1e-5)
        ratio[longest, column] = ACROSS
        assert np.allclose(ratio, ACROSS, atol=1e-5)
        assert np.array_equal(half["sh_rest"], one["sh_rest"]) and np.array_equal(half["sh_dc"], one["sh_dc"])
        assert np.allclose(half["opacity_logits"], half_logits(one["opacity_logits"].astype(np.float64)), atol=1e-5)


def test_opacities_of_halves() -> None:
    logits = np.array([-1e30, -200.0, -80.0, -10.0, 0.0, 4.0, 20.0, 300.0, 1e30])
    halves = half_logits(logits)
    assert np.isfinite(halves).all() and (np.diff(halves) >= 0).all()
    opacity, half = 1 / (1 + np.exp(-logits[3:7])), 1 / (1 + np.exp(-halves[3:7]))
    assert (half < opacity).all()
    # Faint: together as much as the whole. Opaque: between half of it and what would make the middle as opaque.
    assert half[0] * 2 * ALONG == pytest.approx(opacity[0], rel=0.02)
    assert 0.5 < half[-1] < 0.7
    extreme = MemorySource({**everything(random_scene(2)), "log_scales": np.full((3, 2), 3e38, np.float32)})
    with np.errstate(all="raise", under="ignore", over="ignore"):
        assert np.isfinite(everything(PartsSource(extreme, 8, ONE))["means"]).all()


@pytest.mark.parametrize(("times", "least"), [(2, 46.5), (3, 45.2), (4, 43.5), (8, 39.0)])
def test_the_look_stays(sample_dir: Path, times: int, least: float) -> None:
    """Fidelity of the sample in parts to its own renders; all 80 views: 46.95, 45.68, 43.98 and 39.98 dB."""
    parent = open_scene(sample_dir / "point_cloud.ply")
    cameras = read_cameras(sample_dir / "cameras.json")[::10]
    budget = MemoryBudget.from_limit(2**31)
    backend = open_backend(None, budget)
    renderer = Renderer(backend, budget, 0.2, (0.0, 0.0, 0.0), False)
    images = []
    for source in (parent, PartsSource(parent, times * parent.count, ONE)):
        with renderer.load(source) as loaded:
            images.append([np.clip(renderer.render(loaded, camera), 0, 1) for camera in cameras])
    renderer.release()
    backend.close()
    values = [psnr(float(np.mean((a - b) ** 2))) for a, b in zip(*images)]
    assert np.mean([value for value in values if value is not None]) > least


def test_tiles_stand_side_by_side() -> None:
    parent = random_scene(400, spread=3.0)
    shifts = tile_shifts(parent, 7)
    assert not shifts[0].any() and len({tuple(shift) for shift in shifts}) == 7
    means = everything(parent)["means"]
    low, high = np.quantile(means, (0.01, 0.99), axis=1)
    # z, from 2 to 6, is the shortest: tiles are moved along x and y, by no less than the scene is wide.
    assert not shifts[:, 2].any()
    for axis in (0, 1):
        assert np.diff(np.unique(shifts[:, axis])).min() > (high - low)[axis]
    made = everything(PartsSource(parent, 7 * 400, shifts))
    for tile, shift in enumerate(shifts):
        part = slice(400 * tile, 400 * (tile + 1))
        assert np.allclose(made["means"][:, part] - shift[:, None], means, atol=1e-5)
        assert np.array_equal(made["log_scales"][:, part], everything(parent)["log_scales"])


def test_tiles_of_a_point_are_apart() -> None:
    arrays = everything(random_scene(3))
    arrays["means"] = np.zeros((3, 3), np.float32)
    assert len({tuple(shift) for shift in tile_shifts(MemorySource(arrays), 5)}) == 5


@pytest.mark.parametrize(("views", "tiles"), [(3, 1), (3, 5), (6, 4), (5, 2)])
def test_every_tile_is_seen(views: int, tiles: int) -> None:
    cameras = [make_camera(name=f"view_{i}", translation=(i, 0.0, 0.0)) for i in range(views)]
    shifts = np.arange(3 * tiles, dtype=np.float64).reshape(tiles, 3) * 10
    shifts[0] = 0
    made = tiled_cameras(cameras, shifts)
    assert len(made) == max(views, tiles) and len({camera.name for camera in made}) == len(made)
    seen = set()
    for number, camera in enumerate(made):
        away = camera.center - cameras[number % views].center
        (tile,) = np.flatnonzero(np.abs(shifts - away).max(axis=1) < 1e-9)
        seen.add(int(tile))
    assert seen == {*range(tiles)}
    if tiles == 1:
        assert [camera.name for camera in made] == [camera.name for camera in cameras]


def test_a_scene_and_its_cameras(scene: Path, tmp_path: Path) -> None:
    out = tmp_path / "out" / "big.ply"
    assert synth(out, scene, 1000) == 1 and PlySource(out).count == 1000
    for one, other in zip(read_cameras(scene.parent), read_cameras(out.parent), strict=True):
        assert one.name == other.name and (one.width, one.fx, one.fy) == (other.width, other.fx, other.fy)
        assert np.allclose(one.center, other.center) and np.allclose(one.rotation, other.rotation)
    many = 300 * MOST_PARTS * 4 - 5
    assert synth(tmp_path / "more.ply", scene, many) == 4 and PlySource(tmp_path / "more.ply").count == many
    assert len(read_cameras(tmp_path / "cameras.json")) == 4
    with pytest.raises(InputError, match="expected at least the 300"):
        synth(tmp_path / "few.ply", scene, 299)
