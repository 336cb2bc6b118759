"""Scenes with more than one centre of attention, alone: no part of them goes because few views show it."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.candidates import look
from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.io.ply import write_ply
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import contrasting_background
from flexgs_edge.scene.source import MemorySource
from synthetic import joined, make_splats

RED, BLUE = (0.9, 0.2, 0.1), (0.1, 0.6, 0.9)
LEAST = 30.0  # dB of fidelity that every part keeps, from near


def shell(
    count: int, radius: float, middle: tuple[float, float, float] = (0, 0, 0), dark: bool = False
) -> MemorySource:
    """A ball of splats on its surface, in a pattern of two colours, or black."""
    points = fibonacci(count)
    pattern = (np.sin(5 * np.arctan2(points[:, 1], points[:, 0])) * np.sin(6 * points[:, 2]) > 0)[:, None]
    colours = np.zeros((count, 3)) if dark else np.where(pattern, RED, BLUE)
    width = 1.6 * radius / np.sqrt(count)
    return make_splats(points * radius + middle, np.full((count, 3), width), opacity=0.95, colours=colours)


def around(middle: tuple[float, float, float], radius: float) -> list[Camera]:
    """Twelve views of a part, from three radii away."""
    return [
        look(f"free_{place}", middle - line * 3.3 * radius, line, np.array([0.1, -1.0, 0.2]), 96, 96, 96.0)
        for place, line in enumerate(fibonacci(12))
    ]


def to_json(cameras: list[Camera], path: Path) -> Path:
    rows = [
        {
            "id": place, "img_name": camera.name, "width": camera.width, "height": camera.height, "fx": camera.fx,
            "fy": camera.fy, "position": camera.center.tolist(), "rotation": camera.rotation.T.tolist(),
        }
        for place, camera in enumerate(cameras)
    ]  # fmt: skip
    path.write_text(json.dumps(rows))
    return path


SCENES = {
    "a small ball far away": (joined(shell(4000, 1.0), shell(100, 0.3, (30, 0, 0))), ((30.0, 0.0, 0.0), 0.3)),
    "a toy under a sky": (joined(shell(2500, 50.0), shell(1500, 0.25)), ((0.0, 0.0, 0.0), 0.25)),
    "black before black": (joined(shell(2000, 1.0, dark=True), shell(1500, 1.0, (2.2, 0, 0))), ((2.2, 0.0, 0.0), 1.0)),
}


@pytest.mark.parametrize("name", SCENES)
def test_every_part_is_there_from_near(tmp_path: Path, name: str) -> None:
    source, (middle, radius) = SCENES[name]
    write_ply(tmp_path / "scene.ply", source)
    result = compress(tmp_path / "scene.ply", tmp_path / "scene.fgs", CompressOptions(cameras="auto", effort="fast"))
    assert result.reached and result.size < 0.2 * result.scene.ply_bytes
    cameras = to_json(around(middle, radius), tmp_path / "free.json")
    found = evaluate(tmp_path / "scene.fgs", tmp_path / "scene.ply", cameras=str(cameras), images="none", holdout=0)
    assert min(view.fidelity for view in found.quality.views) > LEAST
    if "black" in name:
        assert result.views is not None and "compared before white: 5" in result.views.notes[-1]
        assert result.count > 0.95 * source.count


def test_a_background_that_matter_stands_out_from() -> None:
    black, white = (0.0, 0.0, 0.0), (1.0, 1.0, 1.0)
    coloured, dark = shell(300, 1.0), shell(300, 1.0, dark=True)
    pale = make_splats(fibonacci(300), np.full((300, 3), 0.1), colours=np.ones((300, 3)))
    assert contrasting_background(coloured, black) == (black, None)
    assert contrasting_background(coloured, white) == (white, None)
    assert contrasting_background(dark, white) == (white, None)
    assert contrasting_background(dark, black)[0] == white and contrasting_background(pale, white)[0] == black
    found, note = contrasting_background(joined(dark, pale), black)
    assert found == (0.0, 1.0, 0.0) and note is not None and note.startswith("compared before green: ")
