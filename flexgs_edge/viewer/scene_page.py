"""The viewer's page for one scene: with its files on a server, or with everything in one file."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.viewer.assets import MAIN, PAGE, STYLE, WORKERS
from flexgs_edge.viewer.join import join_modules

_CONFIG = '<script type="application/json" id="scene">{}</script>'
_STYLE_LINK = '<link rel="stylesheet" href="style.css">'
_SCRIPT = '<script type="module" src="src/page.js"></script>'
_CHARSET = '<meta charset="utf-8">'


def page_config(
    name: str, cameras: Sequence[Camera], look: Mapping[str, Any], scene: str | None = None
) -> dict[str, Any]:
    """What the page is told of its scene.

    Parameters
    ----------
    name : str
        Shown on the page.
    cameras : sequence of Camera
        The poses to choose from.
    look : mapping
        How it is drawn: `near`, `background`, `antialiased`.
    scene : str, optional
        Address of the file; left out if its bytes lie in the page.
    """
    config = {"name": name, "poses": [_pose(camera) for camera in cameras], "look": dict(look)}
    return config if scene is None else {**config, "scene": scene}


def _pose(camera: Camera) -> dict[str, Any]:
    numbers = {name: _short(getattr(camera, name)) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    rotation = [[_short(value) for value in row] for row in camera.rotation.tolist()]
    # The place keeps its digits: scenes may lie far from zero.
    return {"name": camera.name, **numbers, "position": camera.center.tolist(), "rotation": rotation}


def _short(value: float) -> float:
    """Nine digits: more than a pixel in a picture of any size can tell."""
    return value if isinstance(value, int) else float(f"{value:.9g}")


def served_files(files: Mapping[str, str], config: Mapping[str, Any]) -> dict[str, str]:
    """The page with what it is told and the files beside it, by their paths.

    Modules are joined, so that they come with one request and not one after the other.
    """
    scripts = {path: join_modules(files, path) for path in (MAIN, *WORKERS.values())}
    return {PAGE: _replaced(files[PAGE], {_CONFIG: _config(config)}), STYLE: files[STYLE], **scripts}


def single_page(files: Mapping[str, str], config: Mapping[str, Any], scene: bytes) -> str:
    """A page that opens from disk: viewer, decoder and scene in one file, which may load nothing from anywhere.

    Workers start from texts in the page. The policy lets only the page's own script run, by its checksum.
    """
    script = join_modules(files, MAIN)
    workers = "".join(
        f'<script type="text/plain" id="{name}-worker">{join_modules(files, path)}</script>\n'
        for name, path in WORKERS.items()
    )
    for text in (script, workers.replace("</script>\n", "")):
        if "</script" in text.lower() or "<!--" in text:
            raise AssertionError("a script that would end in the middle")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = (
        f"default-src 'none'; script-src 'sha256-{digest}' blob:; worker-src blob:; style-src 'unsafe-inline'; "
        "img-src data: blob:; base-uri 'none'; form-action 'none'"
    )
    data = base64.b64encode(scene).decode()
    return _replaced(
        files[PAGE],
        {
            _CHARSET: f'{_CHARSET}\n<meta http-equiv="Content-Security-Policy" content="{policy}">',
            _STYLE_LINK: f"<style>\n{files[STYLE]}</style>",
            _CONFIG: _config(config),
            _SCRIPT: f'{workers}<script type="application/octet-stream" id="scene-bytes">{data}</script>\n'
            f'<script type="module">{script}</script>',
        },
    )


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
