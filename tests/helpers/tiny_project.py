"""A scene of a few hundred Gaussians with cameras and photos, small enough for the NumPy twins."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.camera_files import inria_json
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.commands.compress import compress
from flexgs_edge.io.ply import write_ply
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.report.results import CompressResult
from scene_files import open_scene
from synthetic import look_from, make_camera, random_scene

COUNT, VIEWS, WIDTH, HEIGHT = 400, 9, 40, 30
FAST: dict[str, Any] = {"method": "paper", "effort": "fast", "holdout": 4}
"""Options of a short search by the paper's method."""


def write_cameras(path: Path, views: int = VIEWS) -> Path:
    """`views` poses around the middle of `random_scene`."""
    cameras = []
    for index in range(views):
        rotation, translation = look_from(index)
        cameras.append(make_camera(WIDTH, HEIGHT, rotation=rotation, translation=translation, name=f"v{index:02}"))
    path.write_text(inria_json(cameras))
    return path


def write_photos(folder: Path, scene: Path, cameras: Path, noise: float = 0.02) -> Path:
    """Renders of the scene plus noise, as PNG."""
    budget = MemoryBudget(2**30)
    renderer = Renderer(open_backend(None, budget), budget)
    rng = np.random.default_rng(7)
    folder.mkdir()
    with renderer.load(open_scene(scene)) as loaded:
        for camera in read_cameras(cameras):
            image = renderer.render(loaded, camera)
            image = np.clip(image + rng.normal(0, noise, image.shape), 0, 1)
            Image.fromarray((image * 255).round().astype(np.uint8)).save(folder / f"{camera.name}.png")
    return folder


def make_project(folder: Path, photos: bool = True, degree: int = 1) -> Path:
    """A folder with point_cloud.ply, cameras.json and (with `photos`) images/."""
    folder.mkdir(exist_ok=True)
    scene = folder / "point_cloud.ply"
    write_ply(scene, random_scene(COUNT, seed=3, degree=degree))
    cameras = write_cameras(folder / "cameras.json")
    if photos:
        write_photos(folder / "images", scene, cameras)
    return folder


def compress_project(project: Path, folder: Path) -> CompressResult:
    """The scene of a project, compressed against its photos to `a.fgs` in a folder, with its scores in `s.npz`."""
    scores = str(folder / "s.npz")
    return compress(project / "point_cloud.ply", folder / "a.fgs", max_drop=2.0, score_cache=scores, **FAST)
