"""A scene for viewers, what `render` draws of it, and a browser that draws with WebGL2, in software."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import browser as browser_module
from browser import Browser, find_browser
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.render import render_views
from grid_scenes import sample_grid
from viewer_tab import LOOK, POSES, SOFTWARE, Drawn

THINNED = 4
"""One in so many Gaussians of the sample is drawn: browsers draw in software."""


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
    """A part of the sample: no search, since only the drawing is looked at."""
    place = tmp_path_factory.mktemp("scene") / "still_life.fgs"
    write_grid(place, sample_grid(sample_dir, THINNED), {}, chunk_rows=2048)
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
