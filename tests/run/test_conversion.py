"""Conversions tell what they lose, and refuse what a format cannot hold."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.decompress import WARN_DROP, decompress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import InputError
from flexgs_edge.io.ply import write_ply
from flexgs_edge.io.reading import Writing
from flexgs_edge.io.streamed_sog_writer import STREAMED
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.run.inputs import load_scene, read_scene
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.source import MemorySource, Planes

UTM = np.array([482312.0, 5456784.0, 312.0])
ECEF = np.array([4115235.0, 654321.0, 4812345.0])
LOSSY = [".compressed.ply", ".splat", ".spz", ".sog"]


@pytest.fixture(scope="module")
def planes(sample_dir: Path) -> Planes:
    """Every tenth Gaussian of the bundled scene, with SH of degree 1."""
    source = read_scene(sample_dir / "point_cloud.ply")
    rows = np.arange(0, source.count, 10)
    found = source.read(rows, ["means", "log_scales", "quats", "opacity_logits", "sh_dc", "sh_rest"])
    found["sh_rest"] = found["sh_rest"].reshape(3, 15, -1)[:, :3].reshape(9, -1)
    return found


@pytest.fixture(scope="module")
def far(planes: Planes, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene in UTM coordinates."""
    path = tmp_path_factory.mktemp("far") / "utm.ply"
    write_ply(path, MemorySource(planes, 1, UTM), double=True)
    return path


def with_sky(planes: Planes, distance: float, size: float, count: int = 120) -> MemorySource:
    """The scene under a half sphere of large Gaussians."""
    rng = np.random.default_rng(5)
    away = rng.normal(size=(3, count))
    away /= np.linalg.norm(away, axis=0)
    sky = {name: plane[:, :count].copy() for name, plane in planes.items()}
    sky["means"] = (distance * away).astype(np.float32)
    sky["log_scales"] = np.full((3, count), np.log(size), np.float32)
    sky["opacity_logits"] = np.full((1, count), 4.0, np.float32)
    return MemorySource({name: np.concatenate([planes[name], sky[name]], axis=1) for name in planes}, 1)


def test_a_loss_is_measured_and_warned_of(planes: Planes, sample_dir: Path, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", MemorySource(planes, 1))
    cameras = str(sample_dir / "cameras.json")
    exact = decompress(tmp_path / "a.ply", tmp_path / "a.glb", cameras=cameras)
    assert exact.loss is not None and exact.loss.views == 10 and exact.loss.cameras == cameras
    assert exact.loss.fidelity is None or exact.loss.fidelity > 80
    assert exact.loss.values["position"] == (0.0, 0.0) and exact.warnings == ()
    # A .splat has no SH, which this scene needs.
    write_ply(tmp_path / "b.ply", MemorySource({**planes, "sh_rest": 4 * planes["sh_rest"]}, 1))
    coarse = decompress(tmp_path / "b.ply", tmp_path / "a.splat", cameras=cameras)
    assert coarse.loss is not None and coarse.loss.drop is not None and coarse.loss.drop > WARN_DROP
    assert f"lose {coarse.loss.drop:.2f} dB, since .splat" in coarse.warnings[0]
    record = coarse.to_json()
    assert record["loss"]["drop"] == coarse.loss.drop and record["warnings"] == list(coarse.warnings)
    assert "modelled drop" in coarse.summary()


@pytest.mark.parametrize("suffix", [".compressed.ply", ".splat", ".spz"])
def test_the_loss_is_that_of_evaluate(sample_dir: Path, tmp_path: Path, suffix: str) -> None:
    scene = sample_dir / "point_cloud.ply"
    loss = decompress(scene, tmp_path / f"a{suffix}").loss
    quality = evaluate(tmp_path / f"a{suffix}", scene).quality
    assert loss is not None and loss.drop is not None and quality.usual_drop is not None and loss.base_psnr is None
    assert abs(loss.drop - quality.usual_drop) < 0.01 and loss.views == len(quality.views)
    assert f"drop {loss.drop:.3f} dB against the photos" in "\n".join(loss.lines())


def test_pictures_that_are_not_compared_have_a_reason(planes: Planes, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", MemorySource(planes, 1))
    unseen = decompress(tmp_path / "a.ply", tmp_path / "a.spz", cameras="none")
    assert unseen.loss is not None and unseen.loss.views == 0 and "not compared: --cameras none" in unseen.summary()
    elsewhere = decompress(tmp_path / "a.ply", tmp_path / "b.spz", device="no such device")
    assert elsewhere.loss is not None and "no such device" in elsewhere.loss.why
    twins = decompress(tmp_path / "a.ply", tmp_path / "e.spz", device="numpy")
    assert twins.loss is not None and "NumPy draws slowly" in twins.loss.why
    limit = MemoryBudget.from_limit(None).used + 40 * 2**20
    tight = decompress(tmp_path / "a.ply", tmp_path / "d.spz", memory_limit=limit)
    assert tight.loss is not None and "the OpenCL runtime needs 112MiB" in tight.loss.why
    with pytest.raises(InputError, match=r"none\.json"):
        decompress(tmp_path / "a.ply", tmp_path / "c.spz", cameras=str(tmp_path / "none.json"))
    assert not (tmp_path / "c.spz").exists()


def test_levels_of_a_streamed_scene_are_compared_as_pictures(planes: Planes, sample_dir: Path, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", MemorySource(planes, 1))
    found = decompress(tmp_path / "a.ply", tmp_path / "s" / STREAMED, cameras=str(sample_dir / "cameras.json")).loss
    assert found is not None and found.values == {} and found.fidelity is not None and found.fidelity > 40


@pytest.mark.parametrize("suffix", [".compressed.ply", ".sog", ".spz", ".splat", ".glb"])
def test_a_sky_costs_what_is_near_no_digits(planes: Planes, suffix: str, sample_dir: Path, tmp_path: Path) -> None:
    cameras = str(sample_dir / "cameras.json")
    losses = []
    for name, source in (("plain", MemorySource(planes, 1)), ("sky", with_sky(planes, 4000.0, 250.0))):
        write_ply(tmp_path / f"{name}.ply", source)
        losses.append(decompress(tmp_path / f"{name}.ply", tmp_path / f"{name}{suffix}", cameras=cameras).loss)
    plain, sky = (99.0 if loss.fidelity is None else loss.fidelity for loss in losses if loss is not None)
    assert sky > min(36.0, plain - 4.5)


def test_a_sky_too_far_for_a_format_is_counted_first(planes: Planes, tmp_path: Path) -> None:
    source = with_sky(planes, 3e6, 2e5, 40)
    write_ply(tmp_path / "a.ply", source)
    words = rf"\d+ of {source.count} Gaussians move by more than their own size, since \.spz rounds .* by up to 0\.\d"
    with pytest.raises(InputError, match=words):
        compress(tmp_path / "a.ply", tmp_path / "a.spz", cameras="auto")
    with pytest.raises(InputError, match=words):
        decompress(tmp_path / "a.ply", tmp_path / "a.spz")
    written = decompress(tmp_path / "a.ply", tmp_path / "a.spz", writing=Writing(force_lossy=True), cameras="none")
    assert "Gaussians move by more than their own size" in written.warnings[0]
    beyond = with_sky(planes, 9e6, 2e5, 40)
    write_ply(tmp_path / "b.ply", beyond)
    with pytest.raises(InputError, match=rf"\d+ of {beyond.count} Gaussians lie beyond 8388607"):
        decompress(tmp_path / "b.ply", tmp_path / "b.spz", writing=Writing(force_lossy=True))


@pytest.mark.parametrize("suffix", LOSSY)
def test_scenes_far_from_zero_are_refused_or_moved(far: Path, suffix: str, tmp_path: Path) -> None:
    path = tmp_path / f"a{suffix}"
    words = rf"{suffix} holds these coordinates only to .*, and the smallest splat measures .*--recenter"
    with pytest.raises(InputError, match=words):
        decompress(far, path)
    with pytest.raises(InputError, match=words):
        compress(far, path)
    found = decompress(far, path, recenter=True)
    beside = json.loads((tmp_path / f"a{suffix}.offset.json").read_text())
    signs = [1, -1, -1] if suffix == ".spz" else [1, 1, 1]
    assert beside["axes"] == ("RUB" if suffix == ".spz" else "RDF")
    np.testing.assert_array_equal(beside["offset"], read_scene(far).origin * signs)
    assert found.loss is not None and found.loss.values["position_by_size"][0] < 0.1
    assert found.loss.fidelity is not None and found.loss.fidelity > 30
    path.unlink()
    with pytest.raises(InputError, match=r"offset\.json: the file exists"):
        decompress(far, path, recenter=True)


def test_earth_centred_scenes_and_streamed_ones(planes: Planes, tmp_path: Path) -> None:
    write_ply(tmp_path / "ecef.ply", MemorySource(planes, 1, ECEF), double=True)
    means = read_scene(tmp_path / "ecef.ply").read(slice(None), ["means"])["means"]
    for name in ("a.glb", "a.ply"):
        decompress(tmp_path / "ecef.ply", tmp_path / name, cameras="none")
        found = read_scene(tmp_path / name)
        away = (
            found.read(slice(None), ["means"])["means"]
            + (found.origin - read_scene(tmp_path / "ecef.ply").origin)[:, None]
        )
        assert np.abs(np.sort(away) - np.sort(means)).max() < 1e-5, name
    for name in ("a.spz", "a.sog", "a.splat", "a.compressed.ply", f"s/{STREAMED}"):
        with pytest.raises(InputError, match=r"holds these coordinates only to .*, and the smallest splat measures"):
            decompress(tmp_path / "ecef.ply", tmp_path / name, cameras="none")
    decompress(tmp_path / "ecef.ply", tmp_path / "s" / STREAMED, recenter=True, cameras="none")
    assert (
        json.loads((tmp_path / "s.offset.json").read_text())["offset"]
        == read_scene(tmp_path / "ecef.ply").origin.tolist()
    )


def test_a_search_may_move_a_scene_to_zero(far: Path, sample_dir: Path, tmp_path: Path) -> None:
    cameras = [
        type(camera)(
            camera.name, 160, 120, camera.rotation, camera.translation - camera.rotation @ UTM,
            camera.fx * 160 / camera.width, camera.fy * 120 / camera.height, 79.5, 59.5,
        )
        for camera in read_cameras(sample_dir / "cameras.json")[:12]
    ]  # fmt: skip
    found = compress(far, tmp_path / "a.spz", effort="fast", recenter=True, given=GivenViews(cameras))
    assert found.reached and found.promise is not None
    beside = json.loads((tmp_path / "a.spz.offset.json").read_text())
    scene = load_scene(tmp_path / "a.spz").source
    means = scene.read(slice(0, scene.count), ["means"])["means"]
    assert np.abs(means).max() < 100 and beside["offset"][0] == read_scene(far).origin[0]


def test_a_ply_needs_neither(far: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--recenter: a .ply holds"):
        decompress(far, tmp_path / "a.ply", recenter=True)
    with pytest.raises(InputError, match="--force-lossy: a .fgs holds"):
        compress(far, tmp_path / "a.fgs", force_lossy=True)
