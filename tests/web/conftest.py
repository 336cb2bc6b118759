"""A browser that draws with WebGL2, in software."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import browser as browser_module
from browser import Browser, find_browser
from viewer_tab import SOFTWARE


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
