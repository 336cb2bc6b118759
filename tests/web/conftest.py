"""A scene for viewers, what `render` draws of it, and a browser that draws with WebGL2, in software."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import browser as browser_module
from browser import Browser, find_browser
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.render import render_views
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.fields import FIELD
from viewer_tab import LOOK, POSES, SOFTWARE, Drawn

FINE = StepSizes(0.003, 0.1, 0.02, 0.2, 0.03, (0.03, 0.03, 0.03))


@pytest.fixture(scope="module")
def tab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    program = find_browser()
    if program is None:
        pytest.skip("no Chromium: the viewer's pictures need one")
    with pytest.MonkeyPatch.context() as patch:
        flags = tuple(flag for flag in browser_module.FLAGS if flag != "--disable-gpu")
        patch.setattr(browser_module, "FLAGS", (*flags, *SOFTWARE))
        with Browser(program, tmp_path_factory.mktemp("profile")) as made:
            if not made.run("Boolean(document.createElement('canvas').getContext('webgl2'))"):
                pytest.skip("this Chromium has no WebGL2, not even in software")
            yield made


@pytest.fixture(scope="module")
def scene(sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample, coded on a fine grid in two layers: no search, since only the drawing is looked at."""
    source = PlySource(sample_dir / "point_cloud.ply")
    planes = source.read(slice(0, source.count), list(FIELD))
    layer = np.arange(source.count) % 2
    degrees = np.full(source.count, source.sh_degree)
    grid = to_grid(planes, degrees, FINE, tuple(source.origin), layer)[0]
    place = tmp_path_factory.mktemp("scene") / "still_life.fgs"
    write_grid(place, grid, {}, chunk_rows=8192)
    return place


@pytest.fixture(scope="module")
def drawn(scene: Path, sample_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Drawn:
    """The files that `render` writes, drawn once."""

    @cache
    def draw(antialiased: bool) -> tuple[str, ...]:
        folder = tmp_path_factory.mktemp("drawn")
        cameras = str(sample_dir / "cameras.json")
        return render_views(scene, folder, views=POSES, cameras=cameras, antialiased=antialiased, **LOOK).files

    return draw
