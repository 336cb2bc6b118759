"""Cameras and photos that lie beside a scene in other programs' layouts."""

from __future__ import annotations

from pathlib import Path

import pytest

from camera_files import colmap_records, write_colmap, write_transforms
from flexgs_edge.run.inputs import companions_of
from synthetic import make_camera


@pytest.mark.parametrize("layout", ["nerf-synthetic", "nerfstudio"])
def test_layouts_of_data_sets(tmp_path: Path, layout: str) -> None:
    (tmp_path / "scene.ply").touch()
    cameras = [make_camera(name=f"r_{i}") for i in range(3)]
    if layout == "nerf-synthetic":
        write_transforms(tmp_path / "transforms_train.json", cameras)
        expected, photos = tmp_path / "transforms_train.json", tmp_path / "train"
    else:
        expected = write_colmap(tmp_path / "colmap/sparse/0", *colmap_records(cameras))
        photos = tmp_path / "images"
    photos.mkdir()
    found = companions_of(tmp_path / "scene.ply")
    assert (found.cameras, found.images) == (expected, photos)
