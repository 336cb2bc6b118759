"""`views`: draw all views of a scene on one sheet, to see at a glance where they stand."""

from __future__ import annotations

import math
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.commands.render import write_png
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_writable
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.file_results import RenderResult
from flexgs_edge.run.decoding import decode_bytes
from flexgs_edge.run.foresight import drawing_bytes
from flexgs_edge.run.inputs import scene_info
from flexgs_edge.run.open_renderer import drawn_info, load_drawn, open_renderer
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info

WIDTH, LABEL = 320, 14
"""Pixels: width of a picture on the sheet, and height of the line above it."""


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
