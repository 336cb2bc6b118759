"""Writers of camera files in every format that the readers know, from `Camera` objects."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.json_values import load_json
from flexgs_edge.cameras.read import cameras_of_list
from flexgs_edge.cameras.transforms import cameras_of_frames

MODEL_IDS = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FOV": 7}
Lens = tuple[int, str, int, int, Sequence[float]]
Image = tuple[int, Sequence[float], Sequence[float], int, str]


def read_inria(path: Path | str) -> list[Camera]:
    """The cameras of INRIA's cameras.json in the file's order."""
    return cameras_of_list(Path(path), load_json(Path(path)))


def read_transforms(path: Path | str, ignore_distortion: bool = False, dataparser: Path | None = None) -> list[Camera]:
    """The cameras of a transforms.json in the file's order."""
    return cameras_of_frames(Path(path), load_json(Path(path)), ignore_distortion, dataparser)


def quaternion(rotation: np.ndarray) -> list[float]:
    """W x y z of a rotation, by its eigenvector (another way than the reader's formula)."""
    m = rotation
    k = np.array(
        [
            [m[0, 0] - m[1, 1] - m[2, 2], 0, 0, 0],
            [m[0, 1] + m[1, 0], m[1, 1] - m[0, 0] - m[2, 2], 0, 0],
            [m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], m[2, 2] - m[0, 0] - m[1, 1], 0],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], m[0, 0] + m[1, 1] + m[2, 2]],
        ]
    )
    vectors = np.linalg.eigh(k / 3)[1]
    x, y, z, w = vectors[:, 3]
    return [float(v) for v in (w, x, y, z)]


def colmap_records(cameras: Sequence[Camera]) -> tuple[list[Lens], list[Image]]:
    lenses: list[Lens] = []
    images: list[Image] = []
    for index, c in enumerate(cameras):
        lenses.append((index + 1, "PINHOLE", c.width, c.height, (c.fx, c.fy, c.cx + 0.5, c.cy + 0.5)))
        images.append((index + 7, quaternion(c.rotation), c.translation.tolist(), index + 1, c.name))
    return lenses, images


def lenses_binary(lenses: Sequence[Lens]) -> bytes:
    parts = [struct.pack("<Q", len(lenses))]
    for key, model, width, height, parameters in lenses:
        parts.append(struct.pack("<IiQQ", key, MODEL_IDS.get(model, 99), width, height))
        parts.append(struct.pack(f"<{len(parameters)}d", *parameters))
    return b"".join(parts)


def images_binary(images: Sequence[Image], points: int = 2) -> bytes:
    parts = [struct.pack("<Q", len(images))]
    for key, turn, shift, lens, name in images:
        parts.append(struct.pack("<I7dI", key, *turn, *shift, lens) + name.encode() + b"\0" + struct.pack("<Q", points))
        parts.append(struct.pack("<ddq", 1.5, 2.5, -1) * points)
    return b"".join(parts)


def lenses_text(lenses: Sequence[Lens]) -> str:
    lines = ["# Camera list", f"# Number of cameras: {len(lenses)}"]
    lines += [f"{k} {m} {w} {h} {' '.join(map(repr, map(float, p)))}" for k, m, w, h, p in lenses]
    return "\n".join(lines) + "\n"


def images_text(images: Sequence[Image], points: str = "1.5 2.5 -1 3.0 4.0 17") -> str:
    lines = ["# Image list with two lines of data per image:"]
    for key, turn, shift, lens, name in images:
        lines += [f"{key} {' '.join(repr(float(v)) for v in (*turn, *shift))} {lens} {name}", points]
    return "\n".join(lines) + "\n"


def write_colmap(folder: Path, lenses: Sequence[Lens], images: Sequence[Image], text: bool = False) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    if text:
        (folder / "cameras.txt").write_text(lenses_text(lenses))
        (folder / "images.txt").write_text(images_text(images))
    else:
        (folder / "cameras.bin").write_bytes(lenses_binary(lenses))
        (folder / "images.bin").write_bytes(images_binary(images))
    return folder


def write_inria(path: Path, cameras: Sequence[Camera]) -> Path:
    entries = [
        {
            "id": i, "img_name": c.name, "width": c.width, "height": c.height, "position": c.center.tolist(),
            "rotation": c.rotation.T.tolist(), "fx": c.fx, "fy": c.fy,
        }
        for i, c in enumerate(cameras)
    ]  # fmt: skip
    path.write_text(json.dumps(entries))
    return path


def opengl_matrix(camera: Camera) -> list[list[float]]:
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = camera.center
    return [[float(v) for v in row] for row in matrix]


def transforms_of(cameras: Sequence[Camera], folder: str = "images/") -> dict[str, Any]:
    frames = [
        {
            "file_path": folder + c.name, "w": c.width, "h": c.height, "fl_x": c.fx, "fl_y": c.fy,
            "cx": c.cx + 0.5, "cy": c.cy + 0.5, "transform_matrix": opengl_matrix(c),
        }
        for c in cameras
    ]  # fmt: skip
    return {"camera_model": "OPENCV", "k1": 0.0, "k2": 0, "p1": 0.0, "p2": 0.0, "frames": frames}


def write_transforms(path: Path, cameras: Sequence[Camera], **changes: Any) -> Path:
    path.write_text(json.dumps({**transforms_of(cameras), **changes}))
    return path
