"""The files of the viewer (`web/`)."""

from __future__ import annotations

from pathlib import Path

from flexgs_edge.errors import InputError

PAGE = "viewer/index.html"
STYLE = "viewer/style.css"
ENTRIES = {"page": "viewer/src/page.js", "load": "viewer/src/load-worker.js", "sort": "viewer/src/sort-worker.js"}
"""The modules that are run: the page's, and those of the workers by the name that `startWorker` knows."""
LIVE = {**ENTRIES, "page": "viewer/src/live.js"}
"""The same for the live scenes of a report."""
_PATTERNS = ("viewer/*.html", "viewer/*.css", "viewer/src/*.js", "decoder/src/*.js")


def web_folder() -> Path:
    """The folder of the viewer: `web` inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "web", package.parent / "web"):
        if (candidate / PAGE).is_file():
            return candidate
    raise InputError(f"the viewer: expected {PAGE} in {package / 'web'}, found none: install flexgs-edge again")


def web_files() -> dict[str, str]:
    """Texts of all files that the viewer needs, by their path below `web/`."""
    folder = web_folder()
    places = [place for pattern in _PATTERNS for place in sorted(folder.glob(pattern))]
    return {place.relative_to(folder).as_posix(): place.read_text(encoding="utf-8") for place in places}
