"""The files of the viewer (`web/`)."""

from pathlib import Path

from flexgs_edge.errors import InputError

PAGE = "viewer/index.html"
STYLE = "viewer/style.css"
ENTRIES = {"load": "viewer/src/load-worker.js", "sort": "viewer/src/sort-worker.js", "page": "viewer/src/page.js"}
"""The modules that are run: the page's, and those of the workers by the name that `startWorker` knows. In this order gzip makes
most of them."""
_PLAIN_WORKER = "viewer/src/plain-worker.js"
LIVE = {**ENTRIES, "page": "viewer/src/live.js", "load": _PLAIN_WORKER}  # The same for the live scenes of a report
ELEMENT = {**ENTRIES, "page": "viewer/src/element.js"}  # The same for the element that other pages hold
PLAIN, SPATIAL, PREVIEWED = "plain", "spatial", "previewed"
"""Kinds of scenes: all others, those whose file tells where its chunks lie, and those with a preview. Of a spatial one, the
viewer asks for the chunks in sight first. The viewer of spatial scenes draws the others too; theirs are shorter."""
_KINDS = {
    PLAIN: (_PLAIN_WORKER, "viewer/src/scene-viewer-plain.js"),
    SPATIAL: ("viewer/src/load-worker.js", "viewer/src/scene-viewer.js"),
    PREVIEWED: ("viewer/src/preview-worker.js", "viewer/src/scene-viewer-preview.js"),
}  # Of each kind, the worker that loads, and the module with the viewer
_WORKERS, _OWN_WORKERS = "viewer/src/workers.js", "viewer/src/own-workers.js"
_NOTES, _NO_NOTES = "viewer/src/notes.js", "viewer/src/no-notes.js"
CROP = tuple(f"viewer/src/{name}.js" for name in ("crop", "in-picture", "styled", "vectors"))
"""The module that a page loads when somebody opens what lies under "More", and those that it imports."""
_FORMATS = "decoder/src/formats.js"
_FORMATS_2 = "decoder/src/formats2.js"
_SHORT = "-short.js"  # So end the names of modules that pages of version 2 have in the place of longer ones
_PATTERNS = ("viewer/*.html", "viewer/*.css", "viewer/src/*.js", "decoder/src/*.js")


def web_folder() -> Path:
    """The folder of the viewer: `web` inside the installed package, or beside it in a checkout."""
    package = Path(__file__).resolve().parents[1]
    for candidate in (package / "web", package.parent / "web"):
        if (candidate / PAGE).is_file():
            return candidate
    raise InputError(f"the viewer: expected {PAGE} in {package / 'web'}, found none: install flexgs-edge again")


def entries_of(kind: str) -> dict[str, str]:
    """`ENTRIES` for a kind of scene."""
    return {**ENTRIES, "load": _KINDS[kind][0]}


def web_files(version: int = 1, kind: str = PLAIN, notes: bool = False) -> dict[str, str]:
    """Texts of all files that the viewer needs, by their path below `web/`.

    `version`: container version of the scene. A page of a scene of version 2 reads no other files, so that it is short;
    one of a scene of version 1 reads both. `kind`: kind of the scene. `notes`: whether the page may have any.
    """
    folder = web_folder()
    places = [place for pattern in _PATTERNS for place in sorted(folder.glob(pattern))]
    files = {place.relative_to(folder).as_posix(): place.read_text(encoding="utf-8") for place in places}
    only_2 = files.pop(_FORMATS_2)
    short = {path: files.pop(path) for path in list(files) if path.endswith(_SHORT)}
    if version == 2:
        files[_FORMATS] = only_2
        files.update({path.replace(_SHORT, ".js"): text for path, text in short.items()})
    files[_WORKERS] = files.pop(_OWN_WORKERS)
    without = files.pop(_NO_NOTES)
    if not notes:
        files[_NOTES] = without
    viewers = {name: files.pop(viewer) for name, (_, viewer) in _KINDS.items()}
    files[_KINDS[SPATIAL][1]] = viewers[kind]
    return files
