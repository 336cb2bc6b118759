"""The viewer's page for one scene, which lies beside it on a server or inside it."""

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.viewer.assets import ELEMENT, PAGE, PLAIN, SPATIAL, STYLE, entries_of, web_files
from flexgs_edge.viewer.join import join_modules, shorten_style

_CONFIG = '<script type="application/json" id="scene">{}</script>'
_STYLE_LINK = '<link rel="stylesheet" href="style.css">'
_SCRIPT = re.compile(r'<script type="module" src="src/page.js".*?</script>')
_CANVAS = '<canvas id="canvas"'
POSTER, ELEMENT_SCRIPT, NOTES_FILE = "poster.jpg", "flexgs-scene.js", "notes.json"
NOTES, COMMAND = "notes", "command"  # Names in what the page is told: of the notes, and of the words that crop the file
EMBED = """Upload this folder to any web server. To show the scene in a page of yours, put one of these into it, with the address
of the folder:

<iframe src="https://example.org/folder/" width="960" height="540" style="border: 0" allow="fullscreen; clipboard-write"
  title="A scene in three dimensions" loading="lazy"></iframe>

<script src="https://example.org/folder/flexgs-scene.js"></script>
<flexgs-scene src="https://example.org/folder/scene.fgs" poster="https://example.org/folder/poster.jpg" turn="10"></flexgs-scene>

The element also takes view="...", notes="notes.json" and controls="none"; it tells first, loaded and failed. The page takes
?view= and ?turn= after its address. "Copy a link to this view" in the page's panel makes a view.
The server must not compress scene.fgs on the way. It should answer ranges of bytes; large scenes then load what is in sight.
If your page is on another server than the folder, that server has to allow it (Access-Control-Allow-Origin).
"""
_CHARSET = '<meta charset="utf-8">'


def page_config(
    name: str,
    cameras: Sequence[Camera],
    look: Mapping[str, Any],
    scene: str | None = None,
    notes: Sequence[Mapping[str, Any]] = (),
) -> dict[str, Any]:
    """What the page is told of its scene.

    `name`: shown on the page. `cameras`: the poses to choose from. `look`: how it is drawn: `near`, `background`,
    `antialiased`. `scene`: address of the file; left out if its bytes lie in the page. `notes`: from `read_notes`.
    """
    config: dict[str, Any] = {"name": name, "poses": [_pose(camera) for camera in cameras], "look": dict(look)}
    if notes:
        config[NOTES] = list(notes)
    return config if scene is None else {**config, "scene": scene}


def _pose(camera: Camera) -> dict[str, Any]:
    numbers = {name: _short(getattr(camera, name)) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    rotation = [[_short(value) for value in row] for row in camera.rotation.tolist()]
    # The place keeps its digits: scenes may lie far from zero.
    return {"name": camera.name, **numbers, "position": camera.center.tolist(), "rotation": rotation}


def _short(value: float) -> float:
    """Nine digits: more than a pixel in a picture of any size can tell."""
    return value if isinstance(value, int) else float(f"{value:.9g}")


@dataclass(frozen=True)
class Page:
    """A page of one file."""

    text: str
    policy: str  # what the page may load and run, for a header or an element of its own


def viewer_page(
    files: Mapping[str, str], config: Mapping[str, Any], scene: bytes | None = None, kind: str = PLAIN
) -> Page:
    """The viewer and the decoder in one file.

    With one request, everything but the scene is there. Workers run the page's own script. The policy lets only the page's
    own script and style in, by their checksums.

    `files`: texts of the viewer by path. `config`: from `page_config`. `scene`: a `.fgs` to put into the page, which
    then opens from disk without a network. `kind`: as for `web_files`.
    """
    script = join_modules(files, entries_of(kind))
    if "</script" in script.lower() or "<!--" in script:
        raise AssertionError("a script that would end in the middle")
    style = shorten_style(files[STYLE])
    policy = (
        f"default-src 'none'; script-src {_digest(script)} blob:; worker-src blob:; style-src {_digest(style)}; "
        f"img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    made = f'<script type="module" id="script">{script}</script>'
    (tag,) = _SCRIPT.findall(files[PAGE])
    changes = {tag: made, _STYLE_LINK: f"<style>{style}</style>", _CONFIG: _config(config)}
    if scene is None:
        policy += "; connect-src 'self'"
        if COMMAND in config:  # the box to crop by comes when it is asked for
            policy = policy.replace(" blob:;", " blob: 'self';", 1)
    else:
        changes[_CHARSET] = f'{_CHARSET}\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
        data = base64.b64encode(scene).decode()
        changes[tag] = f'<script type="application/octet-stream" id="scene-bytes">{data}</script>\n{made}'
    return Page(_replaced(files[PAGE], changes), policy)


def site_files(version: int, config: Mapping[str, Any], kind: str, poster: bytes | None = None) -> dict[str, bytes]:
    """The files of a web site by their name, but for the scene: any server of files will do.

    `version`, `kind`: of the scene's file. `config`: from `page_config`; it names the scene. `poster`: a JPEG of the first
    view, which is shown until the scene is.
    """
    notes = config.get(NOTES)
    made = viewer_page(web_files(version, kind, bool(notes)), config, kind=kind)
    policy = made.policy.replace("img-src ", "img-src 'self' ")
    head = f'{_CHARSET}\n<meta http-equiv="Content-Security-Policy" content="{policy}">'
    changes = {_CHARSET: head}
    if poster is not None:
        changes[_CANVAS] = f'<img id="poster" src="{POSTER}" alt="">\n{_CANVAS}'
    site = {"index.html": _replaced(made.text, changes).encode(), "embed.txt": EMBED.encode()}
    site[ELEMENT_SCRIPT] = join_modules(web_files(version, SPATIAL, notes=True), ELEMENT).encode()
    if notes:
        site[NOTES_FILE] = json.dumps(notes, indent=1).encode()
    return site if poster is None else {**site, POSTER: poster}


def _digest(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _config(config: Mapping[str, Any]) -> str:
    # Escaped, so that no name of a file or camera ends the element.
    text = json.dumps(config, allow_nan=False).replace("<", "\\u003c").replace("&", "\\u0026")
    return _CONFIG.replace("{}", text)


def _replaced(page: str, changes: Mapping[str, str]) -> str:
    for old, new in changes.items():
        before, found, after = page.partition(old)
        if not found:
            raise AssertionError(f"the page lacks {old}")
        page = before + new + after
    return page
