"""The files of the viewer (`web/`)."""

from __future__ import annotations

from pathlib import Path

from flexgs_edge.errors import InputError

PAGE = "viewer/index.html"
STYLE = "viewer/style.css"
ENTRIES = {"page": "viewer/src/page.js", "load": "viewer/src/load-worker.js", "sort": "viewer/src/sort-worker.js"}
"""The modules that are run: the page's, and those of the workers by the name that `startWorker` knows."""
SPATIAL = {**ENTRIES, "load": "viewer/src/spatial-worker.js"}
"""The same for a scene whose file tells where its chunks lie."""
LIVE = {**ENTRIES, "page": "viewer/src/live.js"}
"""The same for the live scenes of a report."""
_FORMATS = "decoder/src/formats.js"
_FORMATS_2 = "decoder/src/formats2.js"
_VIEWER = "viewer/src/scene-viewer.js"
_VIEWER_SPATIAL = "viewer/src/scene-viewer-spatial.js"
_PATTERNS = ("viewer/*.html", "viewer/*.css", "viewer/src/*.js", "decoder/src/*.js")


def web_folder() -> Path:
    """The folder of the viewer: `web` inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "web", package.parent / "web"):
        if (candidate / PAGE).is_file():
            return candidate
    raise InputError(f"the viewer: expected {PAGE} in {package / 'web'}, found none: install flexgs-edge again")


def web_files(version: int = 1, spatial: bool = False) -> dict[str, str]:
    """Texts of all files that the viewer needs, by their path below `web/`.

    Parameters
    ----------
    version : int
        Container version of the scene. A page of a scene of version 2 reads no other files, so that it is short; one of a
        scene of version 1 reads both.
    spatial : bool
        The file tells where its chunks lie: with `SPATIAL`, the viewer then asks for those in sight first.
    """
    folder = web_folder()
    places = [place for pattern in _PATTERNS for place in sorted(folder.glob(pattern))]
    files = {place.relative_to(folder).as_posix(): place.read_text(encoding="utf-8") for place in places}
    only_2, chunks_by_sight = files.pop(_FORMATS_2), files.pop(_VIEWER_SPATIAL)
    if version == 2:
        files[_FORMATS] = only_2
    if spatial:
        files[_VIEWER] = chunks_by_sight
    return files
