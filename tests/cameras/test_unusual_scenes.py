"""Automatic views of scenes that nobody trains: no view is empty, nothing is cut off, and nothing fails."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.cameras.auto import Rig, automatic_rig
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource, SceneSource
from kernel_fixtures import draw, drawing, open_form
from synthetic import make_splats

VIEWS = 10


def cloud(count: int = 400, size: float = 0.5, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> np.ndarray:
    return np.random.default_rng(0).normal(size=(count, 3)) * size + at


def splats(points: object, deviations: object, opacity: float = 0.9) -> MemorySource:
    places = np.asarray(points, np.float64)
    return make_splats(places, np.broadcast_to(np.asarray(deviations, np.float64), places.shape), opacity=opacity)


def white(source: SceneSource, count: int | None = None) -> MemorySource:
    """The first `count` Gaussians, white: what is drawn is how much they cover."""
    planes = source.read(slice(0, count or source.count), [name for name in FIELD if name != "sh_rest"])
    planes["sh_dc"] = np.full_like(planes["sh_dc"], 0.5 / 0.28209479177387814)
    return MemorySource(planes, origin=source.origin)


def covered(source: SceneSource, rig: Rig) -> np.ndarray:
    """[V] f64, the share of pixels of each view that Gaussians cover by 4 % or more."""
    near, scene, form = min(rig.near, DEFAULT_NEAR), white(source), open_form("w16")
    images = [draw(form, scene, camera.scaled(40, 30), near=near)[..., 0] for camera in rig.cameras]
    return np.array([(image > 0.04).mean() for image in images])


LINE = np.linspace(-1, 1, 100)[:, None] * np.array([[3.0, 2.0, -1.0]])
SHEET = np.random.default_rng(1).uniform(-3, 3, (800, 3)) * [1, 1, 0]


@pytest.mark.parametrize(
    ("points", "deviations", "least", "mean"),
    [
        pytest.param([[0, 0, 0]], 0.1, 0.15, 0.25, id="one"),
        pytest.param([[1e4, 2e3, -5e3]], 0.1, 0.15, 0.25, id="one, far from zero"),
        pytest.param([[0, 0, 0]], [1, 1e-4, 1e-4], 0.005, 0.06, id="one needle"),
        pytest.param([[0, 0, 0]], [1, 1, 1e-6], 0.1, 0.25, id="one flake"),
        pytest.param([[0, 0, 0], [100, 0, 0]], 0.01, 0.1, 0.3, id="two, far apart"),
        pytest.param(np.zeros((100, 3)), 0.05, 0.25, 0.3, id="all at one point"),
        pytest.param(LINE, 0.05, 0.05, 0.1, id="on a line"),
        pytest.param(LINE * 100, 0.05, 0.005, 0.2, id="far apart on a line"),
        pytest.param(SHEET, [0.15, 0.15, 1e-4], 0.1, 0.4, id="in a plane"),
        pytest.param(np.concatenate([cloud(), cloud(at=(1000, 0, 0))]), 0.05, 0.1, 0.25, id="two clusters"),
        pytest.param(np.concatenate([cloud(), cloud(150, at=(0, 1000, 0))]), 0.05, 0.1, 0.25, id="a smaller cluster"),
        pytest.param(cloud(at=(1e5, -1e5, 3e4)), 0.05, 0.2, 0.5, id="far from zero"),
        pytest.param(np.concatenate([cloud(), [[1e6, 0, 0], [0, -1e5, 0]]]), 0.05, 0.2, 0.5, id="outliers"),
        pytest.param(cloud(), [0.3, 1e-5, 1e-5], 0.2, 0.5, id="needles"),
        pytest.param(cloud(), [0.1, 0.1, 1e-7], 0.2, 0.5, id="flakes"),
        pytest.param(cloud(40, 10.0), 0.02, 0.05, 0.2, id="sparse"),
    ],
)
def test_views_are_filled_by_what_is_there(points: object, deviations: object, least: float, mean: float) -> None:
    source = splats(points, deviations)
    rig = automatic_rig(source, drawing(), VIEWS)
    share = covered(source, rig)
    assert share.min() >= least and share.mean() >= mean, share


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1e6, 1e12])
def test_tiny_and_huge_scenes_are_not_cut_off(scale: float) -> None:
    source = splats(cloud() * scale, 0.05 * scale)
    rig = automatic_rig(source, drawing(), VIEWS)
    distance = np.median([np.linalg.norm(camera.center) for camera in rig.cameras])
    assert 0.05 < rig.near / scale < 1 and 1 < distance / scale < 5
    if scale <= 1e-6:
        assert rig.near < DEFAULT_NEAR
    if 1e-12 < scale < 1e12:  # the renderer's own numbers end
        assert covered(source, rig).min() > 0.2


def test_both_clusters_are_looked_at_closely() -> None:
    source = splats(np.concatenate([cloud(), cloud(200, at=(1000, 0, 0))]), 0.05)
    centres = np.array([camera.center for camera in automatic_rig(source, drawing(), VIEWS).cameras])
    near = [int((np.linalg.norm(centres - [x, 0, 0], axis=1) < 10).sum()) for x in (0, 1000)]
    assert sum(near) == VIEWS and min(near) >= 2


@pytest.mark.parametrize("opacity", [1e-4, 1e-30])
def test_faint_scenes_get_views_too(opacity: float) -> None:
    planes = splats(cloud(), 0.05).read(slice(0, 400), list(FIELD))
    planes["opacity_logits"][:] = math.log(opacity)
    assert len(automatic_rig(MemorySource(planes), drawing(), VIEWS).cameras) == VIEWS


def test_values_at_the_ends_of_float32_do_not_fail() -> None:
    rng = np.random.default_rng(0)
    planes = splats(cloud(60), 0.05).read(slice(0, 60), list(FIELD))
    for field, largest in (("means", 3e38), ("log_scales", 1e30), ("opacity_logits", 1e30), ("quats", 1e18)):
        rows = rng.choice(60, 8, replace=False)
        planes[field][:, rows] = largest * rng.choice([-1.0, 1.0], (len(planes[field]), 8))
    for source in (MemorySource(planes), MemorySource({name: values[:, :3] for name, values in planes.items()})):
        for camera in automatic_rig(source, drawing(), VIEWS).cameras:
            assert np.isfinite(camera.rotation).all() and np.isfinite(camera.translation).all()


@pytest.mark.parametrize(
    ("name", "count", "mean"),
    [("lg-train-1000.ply", 50, 0.08), ("lg-train-1000.ply", None, 0.3), ("ms-train3.ply", None, 0.1)],
)
def test_small_files_fill_their_views(wild: Path, name: str, count: int | None, mean: float) -> None:
    whole = PlySource(wild / name)
    planes = whole.read(slice(0, count or whole.count), list(FIELD))
    source = MemorySource(planes, whole.sh_degree, whole.origin)
    share = covered(source, automatic_rig(source, drawing(), VIEWS))
    assert share.min() > 0.002 and share.mean() > mean, share
