"""One set of poses in all four formats: whichever file a user has, the renders are the same."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from camera_files import colmap_records, write_colmap, write_inria, write_transforms
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.source import SceneSource
from kernel_fixtures import large_budget, open_form
from scene_files import open_scene
from synthetic import look_from, make_camera, random_scene

KINDS = ("inria", "text", "binary", "transforms")
DIGITS_KEPT = ("text", "binary")
"""Formats that say the same numbers: quaternion and translation, in decimal digits that read back and in binary."""
LEAST = 60.0
"""PSNR in dB between renders: turning a rotation into a quaternion, or a translation into a position, costs a last bit of
float64, which now and then is a last bit of float32."""


def write_all(folder: Path, cameras: Sequence[Camera]) -> None:
    for kind in KINDS:
        (folder / kind).mkdir()
    write_inria(folder / "inria" / "cameras.json", cameras)
    write_transforms(folder / "transforms" / "transforms.json", cameras)
    write_colmap(folder / "text", *colmap_records(cameras), text=True)
    write_colmap(folder / "binary", *colmap_records(cameras))


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    error = float(np.mean((np.clip(a, 0, 1).astype(np.float64) - np.clip(b, 0, 1)) ** 2))
    return math.inf if error == 0 else -10 * math.log10(error)


def check(folder: Path, source: SceneSource, cameras: list[Camera], form: str) -> dict[str, float]:
    """The least PSNR of each format against the cameras that were written."""
    write_all(folder, cameras)
    renderer = Renderer(open_form(form), large_budget())
    images: dict[str, list[np.ndarray]] = {}
    with renderer.load(source) as scene:
        images["written"] = [renderer.render(scene, camera) for camera in cameras]
        for kind in KINDS:
            read = {camera.name: camera for camera in read_cameras(folder / kind)}
            assert len(read) == len(cameras)
            images[kind] = [renderer.render(scene, read[camera.name]) for camera in cameras]
    renderer.release()
    assert all(image.std() > 0.05 for image in images["written"]), "an empty picture proves nothing"
    for first, second in itertools.combinations(images, 2):
        apart = min(map(psnr, images[first], images[second]))
        assert apart >= LEAST, f"{first} and {second}: {apart:.1f} dB"
    for first, second in itertools.combinations(DIGITS_KEPT, 2):
        assert all(map(np.array_equal, images[first], images[second])), f"{first} and {second} differ in their bits"
    return {kind: min(map(psnr, images["written"], images[kind])) for kind in KINDS}


def report(found: dict[str, float]) -> None:
    """Shown by `pytest -rP`."""
    print(
        ", ".join(f"{kind} {'same bits' if value == math.inf else f'{value:.1f} dB'}" for kind, value in found.items())
    )


def test_a_small_scene(tmp_path: Path) -> None:
    cameras = []
    for index in range(6):
        turn, shift = look_from(index)
        cameras.append(make_camera(48, 32, rotation=turn, translation=shift, name=f"{index}.jpg"))
    # Far from zero, where float32 positions would have no digits left for a pixel.
    far = np.array([5e4, -2e4, 1e4])
    moved = [camera.moved(-far) for camera in cameras]
    source = random_scene(300, seed=5, degree=2, origin=tuple(far))
    report(check(tmp_path, source, moved, "w16"))


def test_a_real_scene(fox_dir: Path, tmp_path: Path) -> None:
    cameras = read_cameras(fox_dir)
    chosen = [cameras[view] for view in split_views(len(cameras))[1][::3]]
    report(check(tmp_path, open_scene(fox_dir / "point_cloud.ply"), chosen, "w16"))


def test_an_error_of_a_pixel_would_be_seen(fox_dir: Path) -> None:
    """What the limit is worth: half a pixel, the usual slip between conventions, is far below it."""
    camera = read_cameras(fox_dir)[0]
    renderer = Renderer(open_form("w16"), large_budget())
    with renderer.load(open_scene(fox_dir / "point_cloud.ply")) as scene:
        image = renderer.render(scene, camera)
        size = (camera.width, camera.height)
        half = Camera(
            camera.name, *size, camera.rotation, camera.translation, camera.fx, camera.fy, camera.cx + 0.5, camera.cy
        )
        shifted = renderer.render(scene, half)
    renderer.release()
    assert psnr(image, shifted) < 40
