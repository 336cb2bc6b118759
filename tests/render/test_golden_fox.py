"""A real scene against images and statistics of an independent renderer, and against its photos (measure 2)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.harness import read_sums
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.constants import FIXED_ERROR
from flexgs_edge.io.ply import PlySource
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from kernel_fixtures import large_budget, open_form

VIEWS = (0, 24, 40)
FOX_PSNR = (32.71, 32.33, 31.75, 29.26, 32.55, 31.55, 28.07)
"""Of the held-out views 0, 8, ... 48 against the photos, dB (its README)."""
SAMPLE_PSNR = (32.3, 32.0, 32.8, 34.4, 35.5, 36.4, 37.1, 37.3, 36.9, 36.8)
SAMPLE_MEAN = 35.14


@dataclass
class Loaded:
    renderer: Renderer
    scene: DeviceScene
    cameras: list[Camera]
    photos: Photos

    def psnr(self, view: int) -> float:
        image = np.clip(self.renderer.render(self.scene, self.photos.cameras[view]), 0, 1).astype(np.float64)
        return float(-10 * np.log10(np.mean((image - self.photos.load(view)) ** 2)))


def load(folder: Path) -> Loaded:
    cameras = read_cameras(folder / "cameras.json")
    renderer = Renderer(open_form("w16"), large_budget())
    scene = renderer.load(PlySource(folder / "point_cloud.ply"))
    return Loaded(renderer, scene, cameras, Photos.open(folder / "images", cameras, (0.0, 0.0, 0.0)))


@pytest.fixture(scope="module")
def fox(fox_dir: Path) -> Iterator[Loaded]:
    loaded = load(fox_dir)
    yield loaded
    loaded.scene.close()
    loaded.renderer.release()


@pytest.fixture(scope="module")
def golden(fox_dir: Path) -> dict[str, Any]:
    with np.load(fox_dir / "golden.npz") as archive:
        names = [f"{kind}_{view}" for kind in ("image", "hits", "w", "dse") for view in VIEWS]
        assert archive["views"].tolist() == list(VIEWS)
        return {name: archive[name] for name in [*names, "hits_train", "w_train"]}


def assert_same_hits(hits: np.ndarray, expected: np.ndarray) -> None:
    """Within 0.5 % (at least 1) for 99.9 % of the Gaussians, the total within 0.01 %."""
    wrong = abs(hits - expected) > np.maximum(1, 0.005 * expected)
    assert wrong.mean() <= 0.001
    assert abs(hits.sum() - expected.sum()) <= 1e-4 * expected.sum()


@pytest.mark.parametrize("view", VIEWS)
def test_fox_images(fox: Loaded, golden: dict[str, Any], view: int) -> None:
    image = fox.renderer.render(fox.scene, fox.cameras[view])
    expected = np.clip(golden[f"image_{view}"].astype(np.float64), 0, 1)
    error = np.mean((np.clip(image, 0, 1).astype(np.float64) - expected) ** 2)
    assert -10 * np.log10(error) >= 78  # measure 2 asks for 70; half-precision goldens allow 79 to 80


@pytest.mark.parametrize("view", VIEWS)
def test_fox_statistics(fox: Loaded, golden: dict[str, Any], view: int) -> None:
    statistics = Statistics.zeros(fox.scene.count)
    fox.renderer.add_statistics(fox.scene, fox.cameras[view], statistics)
    assert_same_hits(statistics.hits, golden[f"hits_{view}"])
    expected = golden[f"w_{view}"]
    # A flipped hit is worth at most 1/255 at its threshold; sums of float32 differ by their own rounding.
    flips = abs(statistics.hits - golden[f"hits_{view}"])
    assert (abs(statistics.weight_sums - expected) <= 1e-4 * expected + 0.004 * (flips + 1)).mean() >= 0.999
    assert abs(statistics.weight_sums.sum() - expected.sum(dtype=np.float64)) <= 1e-6 * expected.sum(dtype=np.float64)


@pytest.mark.parametrize("view", VIEWS)
def test_fox_removal_costs(fox: Loaded, golden: dict[str, Any], view: int) -> None:
    """Squared errors of removal: the same ranking, and the same sum."""
    sums = fox.renderer.removal_sums(fox.scene, fox.cameras[view])
    costs = read_sums(fox.renderer, sums, 2, fox.scene.count)[0] / FIXED_ERROR
    expected = golden[f"dse_{view}"].astype(np.float64)
    assert abs(costs.sum() - expected.sum()) <= 1e-4 * expected.sum()
    seen = expected > 1e-6
    assert np.quantile(abs(np.log(costs[seen] / expected[seen])), 0.999) <= 0.01


def test_fox_hits_over_the_training_views(fox: Loaded, golden: dict[str, Any]) -> None:
    train, _ = split_views(len(fox.cameras))
    assert len(train) == 43
    statistics = Statistics.zeros(fox.scene.count)
    for view in train:
        fox.renderer.add_statistics(fox.scene, fox.cameras[view], statistics)
    assert_same_hits(statistics.hits, golden["hits_train"].astype(np.int64))
    total = golden["w_train"].sum(dtype=np.float64)
    assert abs(statistics.weight_sums.sum() - total) <= 1e-6 * total


def test_fox_against_its_photos(fox: Loaded) -> None:
    _, held_out = split_views(len(fox.cameras))
    for view, expected in zip(held_out, FOX_PSNR, strict=True):
        assert abs(fox.psnr(view) - expected) <= 0.02


def test_sample_against_its_photos(sample_dir: Path) -> None:
    sample = load(sample_dir)
    _, held_out = split_views(len(sample.cameras))
    figures = [sample.psnr(view) for view in held_out]
    sample.scene.close()
    sample.renderer.release()
    for figure, expected in zip(figures, SAMPLE_PSNR, strict=True):
        assert abs(figure - expected) <= 0.05 + 0.02  # the README gives one decimal
    assert abs(np.mean(figures) - SAMPLE_MEAN) <= 0.02
