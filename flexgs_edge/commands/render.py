"""`render`: draw views of a scene as PNG files, and time them. `views`: draw all of them, small, on one sheet."""

import math
import os
import re
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, check_writable
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.report.file_results import RenderResult
from flexgs_edge.run.decoding import decode_bytes
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_renderer import drawing_bytes, drawn_info, load_drawn, open_renderer
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.quality_evaluator import LIBRARY_BYTES
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info

PNG_LEVEL = 2
"""Effort of the PNG's compression: a fourth of the default's time, 8 to 21 % more bytes. docs/results/tuning.md#png_level"""
PICTURE_BYTES = 48  # Bound on the bytes a pixel of a view that is read, rounded and written as PNG
WIDTH, LABEL = 320, 14  # Pixels: width of a picture on the sheet, and height of the line above it


def render_views(
    input: str | Path,  # a scene file or a model folder
    output: str | Path,  # folder for the files; created if it does not exist
    options: ViewOptions | None = None,  # options as on the command line
    views: Sequence[int] | None = None,  # Indices of the views to draw, in order of name. Default: all views.
    force: bool = False,  # Overwrite existing files. Default: raise `InputError`.
    progress: Progress = SILENT,  # shows a bar
    **words: Any,  # single options, by the names of `ViewOptions`
) -> RenderResult:
    """Draw views of a scene as PNG files, `<view name>.png`, with 8 bits per channel.

    Returns files, and the time of each view.
    """
    options = replace(options or ViewOptions(), **words)
    run = open_run(input, options, progress, photos=False)
    found, clock = run.seen, run.clock
    with clock.stage("open"):
        chosen = _choose(views, len(found.cameras))
        places = _places(Path(output), [found.cameras[i].name for i in chosen], force)
    seconds = []
    writing = LIBRARY_BYTES + PICTURE_BYTES * max(found.cameras[i].width * found.cameras[i].height for i in chosen)

    def needed() -> int:
        return writing + drawing_bytes(run) + decode_bytes(run.source, None)

    with open_renderer(run, needed=needed, compares=False) as renderer:
        run.budget.take("writing pictures", writing)
        with load_drawn(run, renderer) as device_scene:
            started = time.perf_counter()
            with clock.stage("warm up"):
                # Draw one view first: it builds kernels and lists, which the timed views should not pay for.
                renderer.render(device_scene, found.cameras[chosen[0]])
            warm_up = time.perf_counter() - started
            for i, place in zip(progress.track(chosen, "rendering", len(chosen)), places, strict=True):
                started = time.perf_counter()
                with clock.stage("render"):
                    image = renderer.render(device_scene, found.cameras[i])
                seconds.append(time.perf_counter() - started)
                with clock.stage("write"):
                    write_png(place, image, force)
        LOG.info("wrote %d PNG files to %s", len(places), output)
        return RenderResult(
            scene=scene_info(run.scene),
            views=views_info(found),
            files=tuple(os.fspath(place) for place in places),
            view_seconds=tuple(seconds),
            warm_up_seconds=warm_up,
            run=drawn_info(run, renderer),
        )


def write_png(path: Path, image: np.ndarray, force: bool = False) -> None:
    """Write [H, W, 3] f32 as a PNG, clamped to [0, 1] and rounded to 8 bits."""
    from PIL import Image

    pixels = np.rint(np.clip(image, 0.0, 1.0) * 255.0).astype(np.uint8)
    with atomic_write(path, force) as file:
        Image.fromarray(np.ascontiguousarray(pixels)).save(file, format="PNG", compress_level=PNG_LEVEL)


def _choose(views: Sequence[int] | None, count: int) -> list[int]:
    if views is None:
        return list(range(count))
    bad = [i for i in views if not 0 <= i < count]
    if bad:
        raise InputError(f"--views: no view {bad[0]}; the {count} views are 0 to {count - 1} in order of name")
    if not views:
        raise InputError("--views: no view chosen")
    return list(dict.fromkeys(views))


def _places(folder: Path, names: Sequence[str], force: bool) -> list[Path]:
    """Path of the file for each view. All are checked before anything is drawn."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"-o {folder}: expected a folder, found a file")
    places = [folder / f"{_file_name(name)}.png" for name in names]
    twice = {place for place in places if places.count(place) > 1}
    if twice:
        raise InputError(f"view names: more than one would be written to {sorted(twice)[0]}")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"-o {folder}: cannot make the folder ({error.strerror})") from error
    for place in places:
        check_writable(place, force)
    return places


def _file_name(name: str) -> str:
    """Turn a view's name into a plain file name. Folders in it become part of the name."""
    stem = re.sub(r"\.(jpe?g|png)$", "", name, flags=re.IGNORECASE)
    return re.sub(r"[^\w.-]+", "_", stem).lstrip(".") or "view"


def draw_sheet(
    input: str | Path,  # a scene file or a model folder
    output: str | Path,  # the PNG file
    options: ViewOptions | None = None,
    force: bool = False,  # overwrite an existing file
    progress: Progress = SILENT,  # shows a bar
    **words: Any,  # single options, by the names of `ViewOptions`
) -> RenderResult:
    """Draw all views of a scene, small, on one PNG file; those that are held out have a star.

    Returns the file, and the time of each view.
    """
    if Path(output).suffix.lower() != ".png":
        raise InputError(f"-o {output}: expected a name that ends in .png")
    check_writable(output, force)
    run = open_run(input, replace(options or ViewOptions(), **words), progress, photos=False)
    found, clock = run.seen, run.clock

    def needed() -> int:
        return drawing_bytes(run) + decode_bytes(run.source, None)

    pictures, seconds = [], []
    with open_renderer(run, needed=needed, compares=False) as renderer:
        with load_drawn(run, renderer) as device_scene, clock.stage("render"):
            for camera in progress.track(found.cameras, "rendering", len(found.cameras)):
                started = time.perf_counter()
                small = camera.scaled(WIDTH, max(1, round(WIDTH * camera.height / camera.width)))
                pictures.append(np.clip(renderer.render(device_scene, small), 0.0, 1.0))
                seconds.append(time.perf_counter() - started)
        held = set(found.held_out)
        names = [f"{camera.name}{' *' if view in held else ''}" for view, camera in enumerate(found.cameras)]
        with clock.stage("write"):
            write_png(Path(output), _sheet(pictures, names), force)
        return RenderResult(
            scene=scene_info(run.scene),
            views=views_info(found),
            files=(os.fspath(output),),
            view_seconds=tuple(seconds),
            warm_up_seconds=0.0,
            run=drawn_info(run, renderer),
        )


def _sheet(pictures: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """[H, W, 3] f32, about twice as wide as high, with a name above each picture."""
    from PIL import Image, ImageDraw

    height = LABEL + max(picture.shape[0] for picture in pictures)
    across = min(len(pictures), math.ceil(math.sqrt(1.5 * len(pictures) * height / WIDTH)))
    sheet = np.full((height * -(-len(pictures) // across), WIDTH * across, 3), 0.2, np.float32)
    for place, (picture, name) in enumerate(zip(pictures, names, strict=True)):
        top, left = height * (place // across), WIDTH * (place % across)
        label = Image.new("L", (WIDTH, LABEL))
        ImageDraw.Draw(label).text((2, 1), name, fill=255)
        sheet[top : top + LABEL, left : left + WIDTH] += np.asarray(label, np.float32)[:, :, None] * (0.8 / 255)
        sheet[top + LABEL : top + LABEL + picture.shape[0], left : left + WIDTH] = picture
    return sheet
