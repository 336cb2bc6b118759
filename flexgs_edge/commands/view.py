"""`view`: look at a scene in the browser, from a local server or from one file."""

import gzip
import os
import shutil
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.json_values import Entry, kind, load_json
from flexgs_edge.cameras.start import START, StartView
from flexgs_edge.codec.open_fgs import file_version, read_header
from flexgs_edge.codec.v1.container import Header, write_container
from flexgs_edge.codec.v2.container import BOXES
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.errors import BudgetError, DeviceError, FormatError, InputError, brief
from flexgs_edge.files import atomic_folder, atomic_write, check_folder, check_writable
from flexgs_edge.methods.paper.prune import nonzero_sh
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.packed.quantize import far_contraction, quantize_scene
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.report.file_results import ViewResult
from flexgs_edge.run.fine_file import write_fine
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_renderer import load_drawn, open_renderer
from flexgs_edge.run.open_scene import is_fgs, scene_file
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, ViewOptions
from flexgs_edge.run.reporter import encode
from flexgs_edge.run.run import Run, open_run
from flexgs_edge.run.view_set import ViewSet
from flexgs_edge.units import format_size
from flexgs_edge.viewer.assets import CROP, PAGE, PLAIN, PREVIEWED, SPATIAL, web_files
from flexgs_edge.viewer.scene_page import COMMAND, page_config, site_files, viewer_page
from flexgs_edge.viewer.server import Resource, SceneServer

FINE = BitSpec(xyz=16, dc=16, scale=16, rot=16, opacity=16, rest=16)
"""Bits of a scene that is coded only to be looked at."""
_SCENE_NAME = "scene.fgs"
_SCENE = f"viewer/{_SCENE_NAME}"
PAGE_MOST = 100_000_000  # Bytes of a page that phones and mail still take
NOTES_MOST = 1000  # Most notes of a page, which places all of them with every frame
POSTER_SIZE, POSTER_QUALITY = (960, 540), 60  # It comes before the scene on slow networks, so it is small


def view(
    input: str | os.PathLike[str],
    output: str | os.PathLike[str] | None = None,
    options: ViewOptions | None = None,  # options as on the command line: cameras, and how the scene is drawn
    force: bool = False,  # Overwrite `output`. Default: raise `InputError`.
    progress: Progress = SILENT,  # shows bars
    host: str = "127.0.0.1",
    port: int = 0,
    browser: bool = True,  # open the page in the browser
    notes: str | os.PathLike[str] | None = None,  # a JSON file: texts at places of the scene
    ready: Callable[[SceneServer], None] | None = None,  # called with the server before it serves
    **words: Any,  # single options, by the names of `ViewOptions`
) -> ViewResult:
    """Look at a scene in the browser.

    `input`: a scene file or a model folder. A `.fgs` is shown as it is, other scenes are coded finely. `output`: a name
    that ends in .html for a page of one file, which opens from disk without a network; else a folder, for the files of a web
    site. Default: serve until interrupted. `host`, `port`:
    where to serve. Default: this machine alone, any free port. Returns what was shown, and where.
    """
    one_file = output is not None and Path(output).suffix.lower() in (".html", ".htm")
    if output is not None and not one_file:
        if Path(output).suffix:
            raise InputError(f"-o {output}: expected a name that ends in .html, or a folder")
        check_folder(output, force)
    elif output is not None:
        check_writable(output, force)
    if not 0 <= port <= 65535:
        raise InputError(f"--port {port}: expected 0 to 65535")
    options = replace(options or ViewOptions(), **words)
    texts = [] if notes is None else read_notes(notes)
    try:
        run = open_run(input, options, progress, photos=False, decodes=False)
    except (
        BudgetError,
        DeviceError,
    ) as error:  # a page draws without one; only views without cameras are placed by a device
        if options.device is not None or options.cameras not in (None, AUTO_CAMERAS):
            raise
        LOG.warning("warning: the page opens without prepared views: %s", error)
        run = open_run(input, replace(options, cameras=NO_CAMERAS, up=None), progress, photos=False, decodes=False)
    run.budget.require("the program", 0)
    cameras = [] if run.views is None else list(run.views.cameras)
    look = {"near": run.options.near, "background": run.options.background, "antialiased": run.options.antialiased}
    name = Path(os.fspath(input)).resolve().name
    with _coded(run, input) as scene:
        kind = _kind(read_header(scene))
        files = web_files(file_version(scene), kind, bool(texts))
        size = os.stat(scene).st_size
        if one_file and output is not None:
            config = page_config(name, cameras, look, notes=texts)
            page = viewer_page(files, config, scene.read_bytes(), kind).text.encode()
            with atomic_write(output, force) as file:
                file.write(page)
            if len(page) > PAGE_MOST:
                LOG.warning(
                    "warning: browsers may not open a page of %s: compress the scene first", format_size(len(page))
                )
            return ViewResult(scene_info(run.scene), size, len(cameras), os.fspath(output), len(page))
        config = page_config(name, cameras, look, _SCENE_NAME, texts)
        if output is not None:
            poster = _poster(run, StartView.stored(read_header(scene).settings))
            site = site_files(file_version(scene), config, kind, poster)
            with atomic_folder(output, force) as folder:
                for path, content in site.items():
                    (folder / path).write_bytes(content)
                shutil.copyfile(scene, folder / _SCENE_NAME)
            total = size + sum(len(content) for content in site.values())
            return ViewResult(scene_info(run.scene), size, len(cameras), os.fspath(output), total)
        made = viewer_page(files, {**config, COMMAND: _compress(input, options)}, kind=kind)
        text = made.text.encode()
        resources = {PAGE: Resource("text/html; charset=utf-8", text, gzip.compress(text), made.policy)}
        for place in CROP:
            resources[place] = Resource("text/javascript; charset=utf-8", files[place].encode())
        resources[_SCENE] = Resource("application/octet-stream", scene)
        server = SceneServer(resources, host, port)
        address = server.address(PAGE)
        LOG.info("%s is at %s until Ctrl-C", name, address)
        others = server.address_for_others(PAGE)
        if others is not None:
            LOG.warning("warning: other machines see the scene, too, if they know the address: %s", others)
        if ready is not None:
            ready(server)
        if browser:
            # Beside the server: where only a browser for terminals is there, `open` returns when it ends.
            threading.Thread(target=_open, args=(address,), daemon=True).start()
        try:
            server.serve()
        except KeyboardInterrupt:
            LOG.info("stopped")
        return ViewResult(scene_info(run.scene), size, len(cameras), address, None)


def _compress(input: str | os.PathLike[str], options: ViewOptions) -> list[str]:
    """The command line that reads the same scene, to which the page adds what to keep of it."""
    asked = {"--frame": options.frame, "--lod": options.lod, "--sh-degree": options.sh_degree}
    words = [word for name, value in asked.items() if value is not None for word in (name, str(value))]
    return ["flexgs-edge", "compress", os.fspath(input), *words]


def _poster(run: Run[ViewOptions], start: StartView | None) -> bytes | None:
    """A JPEG of the start view; None without one, or without a device that draws it."""
    if start is None:
        return None
    camera = start.camera(*POSTER_SIZE)
    run = replace(run, views=ViewSet([camera], None, [0], [], START, None))
    try:
        with open_renderer(run) as renderer, load_drawn(run, renderer) as scene:
            picture = renderer.render(scene, camera)
    except (BudgetError, DeviceError) as error:
        LOG.warning("warning: the folder has no poster, since nothing can draw it: %s", error)
        return None
    return encode(picture, POSTER_SIZE, POSTER_QUALITY, short=True)


def _kind(header: Header | GridHeader) -> str:
    """The kind of scene that a page shows."""
    if BOXES in header.settings:
        return SPATIAL
    return PREVIEWED if isinstance(header, GridHeader) and header.preview_bytes else PLAIN


def _open(address: str) -> None:
    if not webbrowser.open(address):
        LOG.warning("no browser opened: open the address by hand")


@contextmanager
def _coded(run: Run[ViewOptions], path: str | os.PathLike[str]) -> Iterator[Path]:
    """The scene as a `.fgs`: the file itself, or a temporary one, which takes no search."""
    place = scene_file(path)
    as_it_is = run.options.frame is None and not run.options.drop_invalid and run.options.crop is None
    if is_fgs(place) and as_it_is and run.scene.input_sh_degree == run.source.sh_degree:
        yield place
        return
    source = run.source
    start = run.scene.start if run.views is None else run.views.start(source)
    settings = {} if start is None else {START: start.to_json()}
    with tempfile.TemporaryDirectory(prefix="flexgs-view-") as folder:
        coded = Path(folder) / _SCENE_NAME
        if not write_fine(coded, run, settings):
            has_sh, contraction = nonzero_sh(source), far_contraction(source)
            rows = np.flatnonzero(has_sh), np.flatnonzero(~has_sh)
            write_container(coded, quantize_scene(source, *rows, FINE, contraction=contraction), settings)
        yield coded


def read_notes(path: str | os.PathLike[str]) -> list[dict[str, Any]]:
    """Read a JSON list of objects with `at` (three numbers, world coordinates) and `text`.

    Raises `InputError` if the file cannot be read, and `FormatError` for any other content.
    """
    found = load_json(Path(path), "the notes")
    if not isinstance(found, list):
        raise FormatError(f"{path}: expected a list of notes, found {kind(found)}")
    if len(found) > NOTES_MOST:
        raise FormatError(f"{path}: expected at most {NOTES_MOST} notes, found {len(found)}")
    return [_note(Entry(f"{path}: note {number}", note)) for number, note in enumerate(found, 1)]


def _note(entry: Entry) -> dict[str, Any]:
    at, text = entry.array("at", (3,)), entry.get("text")
    if not isinstance(text, str) or not text.strip():
        raise entry.fail("text", "a text", brief(text))
    return {"at": at.tolist(), "text": text}
