"""The Python API: arrays and bytes in and out, the same bytes as the command line's."""

from __future__ import annotations

import json
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np
import pytest
from PIL import Image

import flexgs_edge
from camera_files import write_inria
from flexgs_edge import Cameras, CompressOptions, FormatError, InputError, Scene, TargetError
from flexgs_edge.api.words import CompressWords
from flexgs_edge.cli import app
from flexgs_edge.codec.v2.container import write_grid
from grid_scenes import make_grid
from tiny_project import COUNT, HEIGHT, WIDTH, make_project

PAPER: dict[str, Any] = {"method": "paper", "effort": "fast", "holdout": 4, "max_drop": 2.0}
BEST: dict[str, Any] = {"effort": "fast", "holdout": 4, "max_drop": 1.5}


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return make_project(tmp_path_factory.mktemp("api") / "scene")


@pytest.fixture(scope="module")
def scene(project: Path) -> Scene:
    return Scene.from_arrays(**Scene.open(project / "point_cloud.ply").arrays())


@pytest.fixture(scope="module")
def photos(project: Path) -> list[np.ndarray]:
    return [np.asarray(Image.open(path)) for path in sorted((project / "images").iterdir())]


@pytest.fixture(scope="module")
def cameras(project: Path) -> Cameras:
    return Cameras.open(project / "cameras.json")


def command(*arguments: object) -> int:
    with pytest.raises(SystemExit) as left:
        app.main([str(argument) for argument in arguments])
    return int(str(left.value.code))


@pytest.fixture(scope="module")
def coded(
    project: Path, scene: Scene, cameras: Cameras, photos: list[np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, tuple[Path, bytes]]:
    """By method: the file of the command line, and the bytes of `encode` on arrays alone."""
    folder = tmp_path_factory.mktemp("coded")
    found = {}
    for method, options in (("paper", PAPER), ("best", BEST)):
        path = folder / f"{method}.fgs"
        words = [word for name, value in options.items() for word in (f"--{name.replace('_', '-')}", value)]
        assert command("compress", project / "point_cloud.ply", "-o", path, "-q", *words) == 0
        found[method] = path, flexgs_edge.encode(scene, cameras=cameras[:], images=photos, **options)[0]
    return found


@pytest.mark.parametrize("method", ["paper", "best"])
def test_arrays_give_the_bytes_of_the_command_line(coded: dict[str, tuple[Path, bytes]], method: str) -> None:
    path, data = coded[method]
    assert data == path.read_bytes()


def test_an_opened_file_finds_what_lies_beside_it(project: Path, coded: dict[str, tuple[Path, bytes]]) -> None:
    opened = Scene.open(project / "point_cloud.ply")
    data, result = flexgs_edge.encode(opened, **PAPER)
    assert data == coded["paper"][1] and result.output == "memory" and result.scene.path == str(opened.checked.path)
    # Cameras that know their file stand for it: the photos beside it are found.
    cameras = Cameras.open(project / "cameras.json")
    assert flexgs_edge.encode(opened, cameras=cameras, **PAPER)[0] == data
    assert flexgs_edge.encode(project / "point_cloud.ply", cameras=project / "cameras.json", **PAPER)[0] == data


def test_cameras_and_photos_may_come_in_any_order(
    scene: Scene, cameras: Cameras, photos: list[np.ndarray], coded: dict[str, tuple[Path, bytes]]
) -> None:
    data, result = flexgs_edge.encode(scene, cameras=list(cameras)[::-1], images=photos[::-1], **PAPER)
    assert data == coded["paper"][1]
    assert result.views is not None and (result.views.cameras, result.views.images) == ("memory", "memory")


@pytest.mark.parametrize("method", ["paper", "best"])
def test_decode_gives_what_decompress_writes(
    coded: dict[str, tuple[Path, bytes]], tmp_path: Path, method: str, cameras: Cameras
) -> None:
    path, data = coded[method]
    flexgs_edge.decompress(path, tmp_path / "a.ply")
    plain = Scene.open(tmp_path / "a.ply").arrays()
    for decoded in (flexgs_edge.decode(data), flexgs_edge.decode(path), flexgs_edge.decode(memoryview(data))):
        arrays = decoded.arrays()
        assert list(arrays) == list(plain)
        for name, values in arrays.items():
            np.testing.assert_array_equal(values, plain[name], err_msg=name)  # type: ignore[literal-required]
    decoded.save(tmp_path / "b.ply")
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    image = decoded.render(cameras[0])
    flexgs_edge.render_views(path, tmp_path / "views", views=[0], cameras=cameras.path)
    drawn = np.asarray(Image.open(tmp_path / "views" / "v00.png"))
    assert image.shape == (HEIGHT, WIDTH, 3) and image.dtype == np.float32 and image.flags.c_contiguous
    np.testing.assert_array_equal(np.rint(image.clip(0, 1) * 255), drawn)


def test_arrays_come_back_as_they_went_in(scene: Scene) -> None:
    arrays = scene.arrays()
    shapes = {
        "means": (COUNT, 3), "log_scales": (COUNT, 3), "quats": (COUNT, 4), "opacity_logits": (COUNT,),
        "sh_dc": (COUNT, 3), "sh_rest": (COUNT, 3, 3),
    }  # fmt: skip
    assert {name: values.shape for name, values in arrays.items()} == shapes
    assert all(values.dtype == np.float32 and values.flags.c_contiguous for values in arrays.values())
    # Red, green and blue of the first coefficient are the first of each channel's planes.
    planes = scene.source.read(slice(0, COUNT), ["sh_rest"])["sh_rest"]
    np.testing.assert_array_equal(arrays["sh_rest"][:, 0], planes[[0, 3, 6]].T)
    kept = arrays["means"].copy()
    arrays["means"][:] = 0
    np.testing.assert_array_equal(scene.arrays()["means"], kept)
    for rows in (slice(5, 9), slice(None, None, -7), [3, 1, 1], np.array([9, 2]), []):
        part = scene.arrays(rows)  # type: ignore[arg-type]
        chosen = rows if isinstance(rows, slice) else np.asarray(rows, np.int64)
        np.testing.assert_array_equal(part["means"], kept[chosen])
        np.testing.assert_array_equal(part["sh_rest"], arrays["sh_rest"][chosen])
    with pytest.raises(IndexError):
        scene.arrays([COUNT])


def test_far_positions_keep_their_digits(scene: Scene, tmp_path: Path) -> None:
    arrays = scene.arrays()
    far = arrays["means"].astype(np.float64) + np.array([500_000.25, 0, 2.0**-7])
    moved = Scene.from_arrays(**{**arrays, "means": far})
    assert moved.source.origin.any()
    found = moved.arrays()["means"]
    assert found.dtype == np.float64 and np.abs(found - far).max() < 1e-6
    moved.save(tmp_path / "far.ply")
    opened = Scene.open(tmp_path / "far.ply")
    np.testing.assert_array_equal(opened.source.origin, moved.source.origin)
    np.testing.assert_array_equal(opened.arrays()["means"], found)


def test_drawn_antialiased_as_told(scene: Scene, cameras: Cameras) -> None:
    told = Scene.from_arrays(**scene.arrays(), antialiased=True)
    assert told.antialiased and not scene.antialiased
    image = told.render(cameras[0])
    assert not np.array_equal(image, scene.render(cameras[0]))
    data, _ = flexgs_edge.encode(told, method="paper", prune_rate=0.0, sh_rate=0.0, cameras="none")
    assert flexgs_edge.decode(data).antialiased


@pytest.mark.parametrize(
    ("name", "values", "words"),
    [
        ("means", np.zeros((COUNT, 4)), rf"means: expected shape \[N, 3\], found \[{COUNT}, 4\]"),
        ("means", np.float32(1), r"means: expected shape \[N, 3\], found \[\]"),
        ("log_scales", np.zeros((3, COUNT)), rf"log_scales: expected shape \[{COUNT}, 3\], found \[3, {COUNT}\]"),
        ("quats", np.zeros((COUNT - 1, 4)), rf"quats: expected shape \[{COUNT}, 4\], found \[{COUNT - 1}, 4\]"),
        ("opacity_logits", np.zeros((COUNT, 1)), rf"opacity_logits: expected shape \[{COUNT}\], found \[{COUNT}, 1\]"),
        ("sh_dc", np.full((COUNT, 3), "a"), "sh_dc: expected float32 numbers, found <U1"),
        ("sh_rest", np.zeros((COUNT, 4, 3)), rf"sh_rest: .* K of 0, 3, 8, 15 or 24, found \[{COUNT}, 4, 3\]"),
        ("sh_rest", np.zeros((COUNT, 9)), rf"sh_rest: .*found \[{COUNT}, 9\]"),
        ("sh_dc", np.full((COUNT, 3), np.nan), rf"{COUNT} of {COUNT} Gaussians are invalid: NaN or infinity in sh_dc"),
        ("means", np.arange(3.0 * COUNT).reshape(COUNT, 3) * 1e290, "invalid: NaN or infinity in means"),
    ],
)
def test_wrong_arrays_are_named(scene: Scene, name: str, values: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words) as caught:
        Scene.from_arrays(**{**scene.arrays(), name: values})  # type: ignore[arg-type]
    assert isinstance(caught.value, ValueError)


def test_invalid_rows_are_left_out_when_asked(scene: Scene) -> None:
    arrays = scene.arrays()
    arrays["means"][7] = np.nan
    assert Scene.from_arrays(**arrays, drop_invalid=True).count == COUNT - 1
    with pytest.raises(InputError, match="the scene is empty"):
        Scene.from_arrays(**scene.arrays([]))


def test_cameras_of_matrices(cameras: Cameras, project: Path, tmp_path: Path) -> None:
    poses = np.tile(np.eye(4), (len(cameras), 1, 1))
    lenses = np.zeros((len(cameras), 3, 3))
    for pose, lens, camera in zip(poses, lenses, cameras, strict=True):
        pose[:3, :3], pose[:3, 3] = camera.rotation, camera.translation
        lens[:] = [[camera.fx, 0, camera.width / 2], [0, camera.fy, camera.height / 2], [0, 0, 1]]
    sizes = np.tile([WIDTH, HEIGHT], (len(cameras), 1))
    made = Cameras.from_matrices(poses, lenses, sizes, [camera.name for camera in cameras])
    for one, other in zip(made, cameras, strict=True):
        np.testing.assert_array_equal(one.rotation, other.rotation)
        np.testing.assert_array_equal(one.translation, other.translation)
        assert (one.name, one.fx, one.fy, one.cx, one.cy) == (other.name, other.fx, other.fy, other.cx, other.cy)
    assert [camera.name for camera in Cameras.from_matrices(poses, lenses, sizes)][:2] == ["view_00000", "view_00001"]
    assert isinstance(made[1:3], Cameras) and len(made[1:3]) == 2 and made[-1].name == cameras[-1].name
    write_inria(tmp_path / "cameras.json", made)
    assert [camera.name for camera in Cameras.open(tmp_path)] == [camera.name for camera in cameras]

    def refused(words: str, **changed: Any) -> None:
        given = {"world_to_camera": poses, "intrinsics": lenses, "sizes": sizes, **changed}
        with pytest.raises(InputError, match=words):
            Cameras.from_matrices(**given)

    refused(r"world_to_camera: expected \[V, 4, 4\] numbers, found shape \[9, 3, 4\]", world_to_camera=poses[:, :3])
    refused(r"intrinsics: expected \[9, 3, 3\] numbers, found shape \[8, 3, 3\]", intrinsics=lenses[:8])
    refused(r"world_to_camera\[0\]: expected a rotation", world_to_camera=poses * np.array([1, 1, -1, 1]))
    refused("world_to_camera: expected finite numbers", world_to_camera=poses * np.nan)
    refused(r"intrinsics\[0\]: expected \[fx, 0, cx\]", intrinsics=lenses + 0.5)
    refused(r"sizes\[0\]: expected whole numbers of pixels", sizes=sizes + 0.5)
    refused("names: expected 9 names that differ, found 9, 1 different", names=["a"] * 9)


def test_photos_must_fit_their_cameras(scene: Scene, cameras: Cameras, photos: list[np.ndarray]) -> None:
    def refused(words: str, **given: Any) -> None:
        with pytest.raises(InputError, match=words):
            flexgs_edge.encode(scene, **{"cameras": cameras, "images": photos, **given}, **PAPER)

    refused("images: expected 9 photos, one a camera, found 8", images=photos[:8])
    refused(r"images\[0\]: expected .* of uint8, found .* float64", images=[photo / 255 for photo in photos])
    refused(r"images\[0\]: expected shape \[H, W, 3\]", images=[photo[:, :, 0] for photo in photos])
    refused("photos may be smaller than the cameras say", images=[np.tile(photo, (2, 2, 1)) for photo in photos])
    refused("photos need the cameras that took them", cameras=None)
    twice = flexgs_edge.encode(scene, cameras=[replace(camera, name="v") for camera in cameras], images=photos, **PAPER)
    assert twice[0] == flexgs_edge.encode(scene, cameras=cameras, images=photos, **PAPER)[0]
    refused("cameras: expected at least one camera", cameras=[], images=None)


def test_an_alpha_channel_is_put_on_the_background(
    scene: Scene, cameras: Cameras, photos: list[np.ndarray], project: Path, tmp_path: Path
) -> None:
    clear = [np.dstack([photo, np.full(photo.shape[:2], 100, np.uint8)]) for photo in photos]
    for camera, pixels in zip(cameras, clear, strict=True):
        Image.fromarray(pixels).save(tmp_path / f"{camera.name}.png")
    words: dict[str, Any] = {**PAPER, "background": (0.2, 0.5, 1.0), "resolution": 30}
    from_files = flexgs_edge.encode(project / "point_cloud.ply", images=tmp_path, **words)
    from_arrays = flexgs_edge.encode(scene, cameras=cameras, images=clear, **words)
    assert from_arrays[0] == from_files[0] and from_arrays[1].quality == from_files[1].quality


def test_layers_of_a_file(tmp_path: Path, cameras: Cameras) -> None:
    path = tmp_path / "a.fgs"
    write_grid(path, make_grid(900, 2, layers=3), {"target": "drop <= 1 dB"}, chunk_rows=256)
    file = flexgs_edge.open(path)
    assert (file.version, file.count, file.sh_degree) == (2, 900, 2) and file.settings == {"target": "drop <= 1 dB"}
    assert sum(layer.count for layer in file.layers) == 900 and len(file.layers) == 3
    assert file.channels == flexgs_edge.info(path).channels and "position" in file.channels
    whole = file.scene().arrays()
    parts = [file.layer(k).arrays() for k in range(3)]
    for name, values in whole.items():
        joined = np.concatenate([part[name] for part in parts])  # type: ignore[literal-required]
        np.testing.assert_array_equal(joined, values)
    assert file.verify().ok
    sizes = [layer.bytes for layer in file.layers]
    result = file.trim(tmp_path / "b.fgs", path.stat().st_size - sizes[-1] + 200)
    assert result.layers == 2 and result.to_json()["command"] == "trim"
    np.testing.assert_array_equal(
        flexgs_edge.decode(tmp_path / "b.fgs").arrays()["means"], file.scene(2).arrays()["means"]
    )
    assert file.layer(0).render(cameras[0]).shape == (HEIGHT, WIDTH, 3)
    for wrong in (-1, 3):
        with pytest.raises(InputError, match="layer: expected 0 to 2"):
            file.layer(wrong)
    with pytest.raises(InputError, match="layers: expected 1 to 3, found 4"):
        file.scene(4)
    with pytest.raises(TargetError):
        file.trim(tmp_path / "c.fgs", 300)


def test_a_file_of_version_1_is_one_layer(coded: dict[str, tuple[Path, bytes]]) -> None:
    file = flexgs_edge.open(coded["paper"][0])
    assert file.version == 1 and [layer.count for layer in file.layers] == [file.count]
    assert file.layer(0).count == file.scene().count == file.count


def test_damaged_bytes_are_refused(coded: dict[str, tuple[Path, bytes]]) -> None:
    data = bytearray(coded["best"][1])
    with pytest.raises(FormatError):
        flexgs_edge.decode(data[:100])
    with pytest.raises(FormatError):
        flexgs_edge.decode(b"")
    data[-200] ^= 1
    with pytest.raises(FormatError):
        flexgs_edge.decode(data).arrays()


def test_encode_writes_no_dry_run(scene: Scene) -> None:
    for words in ({"dry_run": True}, {"options": CompressOptions(dry_run=True)}):
        with pytest.raises(InputError, match="dry_run: encode hands back"):
            flexgs_edge.encode(scene, **words)  # type: ignore[arg-type]


def test_the_words_are_those_of_the_options() -> None:
    assert set(CompressWords.__annotations__) == {field.name for field in fields(CompressOptions)} - {
        "cameras",
        "images",
    }
    words = get_type_hints(CompressOptions)
    for name, kind in get_type_hints(CompressWords).items():
        assert kind == words[name], name


def test_every_result_has_its_summary_and_its_json(coded: dict[str, tuple[Path, bytes]], project: Path) -> None:
    path = coded["best"][0]
    for result in (flexgs_edge.info(path), flexgs_edge.verify(path), flexgs_edge.devices("numpy?")):
        assert result.summary().endswith("\n") and json.loads(json.dumps(result.to_json(), allow_nan=False))


def test_errors_are_pythons_own_as_well() -> None:
    tree = {
        "InputError": (ValueError, 2),
        "FormatError": (ValueError, 2),
        "TargetError": (ValueError, 3),
        "DeviceError": (RuntimeError, 4),
        "BudgetError": (MemoryError, 5),
    }
    for name, (base, code) in tree.items():
        error = getattr(flexgs_edge, name)
        assert issubclass(error, base) and issubclass(error, flexgs_edge.FlexGSError) and error.exit_code == code
        assert app._exit_code(error("words")) == code
