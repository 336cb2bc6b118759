"""Grid scenes for the tests of the real coder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.curve import morton
from flexgs_edge.scene.fields import FIELDS

STEPS = StepSizes(0.05, 0.25, 0.05, 0.4, 0.1, (0.2, 0.25, 0.3, 0.3))
FINE = StepSizes(0.003, 0.1, 0.02, 0.2, 0.03, (0.03, 0.03, 0.03))


def make_planes(count: int, sh_degree: int = 2, seed: int = 0) -> dict[str, np.ndarray]:
    """Values that vary slowly along x, with noise: something to predict."""
    rng = np.random.default_rng(seed)
    planes = {f.name: rng.normal(size=(f.width(sh_degree), count)).astype(np.float32) for f in FIELDS}
    for name in ("sh_dc", "log_scales", "opacity_logits"):
        planes[name] += 3 * planes["means"][:1]
    return planes


def make_grid(count: int, sh_degree: int = 2, seed: int = 0, layers: int = 1, steps: StepSizes = STEPS) -> GridScene:
    """Rows of every degree up to `sh_degree`, in `layers` layers."""
    rng = np.random.default_rng(seed + 1)
    degrees = rng.integers(0, sh_degree + 1, count)
    layer = rng.integers(0, layers, count)
    return to_grid(make_planes(count, sh_degree, seed), degrees, steps, (1234.5, -0.1, 1e-7), layer)[0]


def sample_grid(sample_dir: Path, thinned: int) -> GridScene:
    """One in `thinned` Gaussians of the sample on a fine grid, in two layers."""
    source = PlySource(sample_dir / "point_cloud.ply")
    planes = source.read(np.arange(0, source.count, thinned), [field.name for field in FIELDS])
    count = planes["means"].shape[1]
    degrees, layer = np.full(count, source.sh_degree), np.arange(count) % 2
    return to_grid(planes, degrees, FINE, tuple(source.origin), layer)[0]


def previewed(scene: Path, folder: Path, chunk_rows: int) -> tuple[Path, Path]:
    """The same scene behind a preview of every eighth row without SH, and that preview."""
    grid = grid_of(scene)
    some = grid.take(np.arange(0, grid.count, 8))
    nothing = np.zeros_like(some.sh_degrees)
    steps = replace(some.step_sizes, sh=())
    flat = replace(some, sh_degree=0, sh_degrees=nothing, sh=(), step_sizes=steps, layer=nothing)
    order = np.argsort(_cells_of_one_layer(flat), kind="stable")
    small, place = folder / "small.fgs", folder / "still_life.fgs"
    write_grid(small, flat.take(order), {})
    write_grid(place, grid, {}, chunk_rows=chunk_rows, preview=small.read_bytes())
    return place, small


def one_layer(grid: GridScene) -> GridScene:
    """The same rows in one layer."""
    order = np.argsort(_cells_of_one_layer(grid), kind="stable")
    return replace(grid.take(order), layer=np.zeros_like(grid.layer))


def grid_of(scene: Path) -> GridScene:
    """The grid of a file of version 2."""
    source = open_fgs(scene)
    assert isinstance(source, GridSource)
    return source.grid()


def _cells_of_one_layer(grid: GridScene) -> np.ndarray:
    return morton(grid.position.astype(np.int64) - grid.position.min(axis=1)[:, None])


def assert_same_grid(one: GridScene, two: GridScene) -> None:
    """Equal codes, steps and layers."""
    assert (one.count, one.sh_degree, one.step_sizes) == (two.count, two.sh_degree, two.step_sizes)
    for name in ("origin", "position", "scale", "rotation", "opacity", "dc", "sh_degrees", "layer"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name), name)
    assert len(one.sh) == len(two.sh)
    for a, b in zip(one.sh, two.sh, strict=True):
        np.testing.assert_array_equal(a, b)
