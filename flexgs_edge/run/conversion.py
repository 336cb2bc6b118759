"""What a conversion lost: values and pictures of the written file against those of the scene."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import BudgetError, DeviceError, InputError
from flexgs_edge.io.codes import opacities
from flexgs_edge.io.exchange import MovedSource, near_order
from flexgs_edge.io.formats import Format
from flexgs_edge.report.file_results import ConversionLoss
from flexgs_edge.run.counted_backend import BUILD_BYTES, RUNTIME_BYTES
from flexgs_edge.run.inputs import CheckedScene, load_scene
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import NO_CAMERAS, ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.run import open_run
from flexgs_edge.scene.source import SceneSource

_ROWS = 1 << 16
"""Rows whose values are compared."""


def conversion_loss(
    scene: CheckedScene,
    output: str | os.PathLike[str],
    options: ViewOptions,
    format: Format | None,
    recentred: bool = False,
) -> ConversionLoss:
    """Compare a written file with its scene, by the views and the photos that `evaluate` takes.

    Parameters
    ----------
    scene : CheckedScene
        What was written.
    output : path
        The file.
    options : ViewOptions
        Cameras, device and memory limit of the pictures.
    format : Format or None
        What the file's rows are ordered for, so that values can be compared; `None`: they have another order.
    recentred : bool
        The file's scene was moved to zero.

    Returns
    -------
    ConversionLoss
        Without pictures where the options name no cameras, or device or memory do not allow any: `why` says so.
    """
    written = load_scene(output)
    if recentred:
        written = replace(written, source=MovedSource(written.source, scene.source.origin))
    values = {} if format is None else _value_errors(scene.source, written.source, format.chunked)
    if options.cameras == NO_CAMERAS:
        return ConversionLoss(values, why=f"--cameras {NO_CAMERAS}")
    if options.device == "numpy" and options.cameras is None:
        return ConversionLoss(values, why="NumPy draws slowly: --cameras PATH compares them all the same")
    try:
        run = open_run(scene, options)
        if options.device != "numpy":
            run.budget.require("the OpenCL runtime", RUNTIME_BYTES + BUILD_BYTES)
        chosen = run.seen.held_out or run.seen.train
        with open_renderer(run) as renderer:
            judge = QualityEvaluator(renderer, run.source, run.seen, chosen)
            with renderer.load(run.source) as original:
                judge.prepare(original)
            with renderer.load(written.source) as drawn:
                quality = judge.compare(drawn)
            judge.close()
    except (BudgetError, DeviceError, InputError) as error:
        return ConversionLoss(values, why=str(error))
    covered = quality.covered_decides
    found = [view.covered_fidelity if covered else view.fidelity for view in quality.views]
    return ConversionLoss(
        values,
        views=len(chosen),
        cameras=run.seen.cameras_from,
        fidelity=quality.deciding_fidelity,
        worst=min((value for value in found if value is not None), default=None),
        drop=quality.usual_drop,
        base_psnr=None if run.seen.photos is not None else quality.base_psnr,
    )


def _value_errors(source: SceneSource, written: SceneSource, chunked: bool) -> dict[str, tuple[float, float]]:
    """Median and largest errors of some rows by value; the size of a splat is its largest deviation."""
    order = near_order(source, chunked)
    rows = np.arange(0, source.count, -(-source.count // _ROWS))
    fields = ["means", "log_scales", "opacity_logits", "sh_dc"]
    before, after = source.select(order[rows]).read(slice(0, rows.size), fields), written.read(rows, fields)
    shift = (written.origin - source.origin)[:, None]
    with np.errstate(over="ignore"):
        sizes = np.exp(before["log_scales"].astype(np.float64).max(axis=0))
    opaque = [opacities(planes["opacity_logits"]) for planes in (before, after)]
    errors = {
        "position": np.abs(after["means"] + shift - before["means"]).max(axis=0),
        "position_by_size": np.abs(after["means"] + shift - before["means"]).max(axis=0) / sizes,
        "log_scale": np.abs(after["log_scales"] - before["log_scales"]).max(axis=0),
        "opacity": np.abs(opaque[1] - opaque[0])[0],
        "colour": np.abs(after["sh_dc"] - before["sh_dc"]).max(axis=0) * SH_C0,
    }
    return {name: (float(np.median(error)), float(error.max())) for name, error in errors.items()}
