"""Photos freed of their lens, against a numerical inverse of the lens, and the pinhole that takes its place."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from camera_files import opengl_matrix, quaternion, write_colmap
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.lens import Lens
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.errors import InputError
from synthetic import make_camera

WIDTH, HEIGHT, FX, FY, CX, CY = 150, 110, 120.0, 125.0, 76.0, 52.5
LENSES = {
    "SIMPLE_RADIAL": (Lens((0.06,)), (0.06,)),
    "RADIAL": (Lens((-0.2, 0.03)), (-0.2, 0.03)),
    "OPENCV": (Lens((0.08, -0.05), (0.002, -0.003)), (0.08, -0.05, 0.002, -0.003)),
    "FULL_OPENCV": (
        Lens((0.1, 0.02, 0.01, 0.05, 0.01, 0.002), (0.001, 0.002)), (0.1, 0.02, 0.001, 0.002, 0.01, 0.05, 0.01, 0.002),
    ),
    "OPENCV_FISHEYE": (Lens((0.03, -0.01, 0.002, 0.0), fisheye=True), (0.03, -0.01, 0.002, 0.0)),
    "RADIAL_FISHEYE": (Lens((0.03, -0.01), fisheye=True), (0.03, -0.01)),
}  # fmt: skip


def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """A smooth picture on the plane at distance 1."""
    waves = [np.sin(4 * x + 3 * y), np.cos(5 * x - 2 * y), np.sin(3 * x * y + 2 * y)]
    return 0.5 + 0.4 * np.stack(waves, axis=2)


def photo_of(lens: Lens, fy: float = FY) -> np.ndarray:
    """[H, W, 3] u8: what the lens shows of `scene`, by a fixed point in place of the formula's direction."""
    u, v = np.meshgrid((np.arange(WIDTH) - CX) / FX, (np.arange(HEIGHT) - CY) / fy)
    x, y = u.copy(), v.copy()
    for _ in range(200):
        a, b = lens.bent(x, y)
        x, y = x + 0.7 * (u - a), y + 0.7 * (v - b)
    a, b = lens.bent(x, y)
    assert max(np.abs(a - u).max(), np.abs(b - v).max()) < 1e-9
    return np.rint(scene(x, y) * 255).astype(np.uint8)


def assert_straight(camera: Camera, pixels: np.ndarray) -> None:
    x, y = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    expected = scene((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
    assert pixels.dtype == np.float32 and np.abs(pixels - expected).max() < 0.008


@pytest.mark.parametrize("model", list(LENSES))
def test_photos_are_freed_of_their_lens(tmp_path: Path, model: str) -> None:
    lens, parameters = LENSES[model]
    focals = (FX,) if model in ("SIMPLE_RADIAL", "RADIAL", "RADIAL_FISHEYE") else (FX, FY)
    pose = make_camera(WIDTH, HEIGHT)
    record = (1, model, WIDTH, HEIGHT, (*focals, CX + 0.5, CY + 0.5, *parameters))
    image = (1, quaternion(pose.rotation), pose.translation.tolist(), 1, "a.png")
    write_colmap(tmp_path, [record], [image], text=True)
    (camera,) = read_cameras(tmp_path)
    assert camera.lens is not None and camera.distortion is None
    assert 1 <= camera.lens.zoom < 1.3 and camera.fx == pytest.approx(FX * camera.lens.zoom)
    Image.fromarray(photo_of(lens, focals[-1])).save(tmp_path / "a.png")
    assert_straight(camera, Photos.open(tmp_path, [camera]).load(0))
    assert Photos.open(tmp_path, [camera]).notes == ("lens distortion removed from 1 photos",)
    half = Photos.open(tmp_path, [camera], max_width=WIDTH // 2)
    x, y = np.meshgrid(np.arange(WIDTH // 2), np.arange(HEIGHT // 2))
    small = half.cameras[0]
    expected = scene((x - small.cx) / small.fx, (y - small.cy) / small.fy)
    assert np.abs(half.load(0) - expected).max() < 0.015


def test_transforms_of_a_lens(tmp_path: Path) -> None:
    lens = Lens((0.08, -0.05), (0.002, -0.003))
    frame = {"file_path": "a.png", "transform_matrix": opengl_matrix(make_camera(WIDTH, HEIGHT))}
    words = {"k1": 0.08, "k2": -0.05, "p1": 0.002, "p2": -0.003, "w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY}
    text = json.dumps({**words, "cx": CX + 0.5, "cy": CY + 0.5, "frames": [frame]})
    (tmp_path / "transforms.json").write_text(text)
    (camera,) = read_cameras(tmp_path)
    Image.fromarray(photo_of(lens)).save(tmp_path / "a.png")
    assert_straight(camera, Photos.open(tmp_path, [camera]).load(0))
    (bent,) = read_cameras(tmp_path, ignore_distortion=True)
    with pytest.raises(InputError, match="photos cannot be compared: camera 'a.png' has lens distortion .k1 = 0.08"):
        Photos.open(tmp_path, [bent])


def test_lenses_that_fold_back_are_refused(tmp_path: Path) -> None:
    image = (1, [1.0, 0, 0, 0], [0.0, 0, 0], 1, "a.png")
    for model, parameters in (("RADIAL", (-3.0, 0.0)), ("FOV", (0.9,))):
        focals = (FX,) if model == "RADIAL" else (FX, FY)
        write_colmap(tmp_path, [(1, model, WIDTH, HEIGHT, (*focals, CX, CY, *parameters))], [image], text=True)
        (camera,) = read_cameras(tmp_path)  # its pose serves
        assert camera.lens is None and camera.distortion == f"lens distortion (COLMAP model {model})"
        with pytest.raises(InputError, match=f"COLMAP model {model}.*--images none"):
            Photos.open(tmp_path, [camera])
