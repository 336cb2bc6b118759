"""`info --errors`: what every channel of a `.fgs` is worth, measured by drawing the scene with less of it."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands.info import info
from flexgs_edge.commands.reduced import DROPPED, ONE_LESS, reduced_scenes
from flexgs_edge.constants import DEFAULT_BASE_PSNR
from flexgs_edge.errors import InputError
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.open_bench import open_bench
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.plan import Plan
from flexgs_edge.run.run import open_run
from flexgs_edge.run.view_set import views_info
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.units import format_size

COPIES = 4
"""Scenes of float32 values that are held at the most: the codes, those of one lesser scene, its values, and coding it."""


def worth(
    path: str | Path, options: ViewOptions | None = None, progress: Progress = SILENT, **words: Any
) -> dict[str, Any]:
    """What `info` finds, and under `errors` what each channel is worth.

    Parameters
    ----------
    path : path
        A `.fgs`.
    options : ViewOptions, optional
        Views as for `evaluate`: cameras given, else beside the file, else automatic; the held-out ones are drawn. Photos are
        not used: the file's own renders are the reference.
    progress : Progress, optional
        A bar.
    **words
        Single options by the names of `ViewOptions`.

    Returns
    -------
    dict
        As `info`; `errors` has the views and, for every channel and change of `reduced_scenes`, the bytes of the file that it
        saves, the fidelity (dB; None where nothing changes) and the modelled drop (dB).
    """
    options = replace(options or ViewOptions(), images=None, **words)
    place = Path(path)
    if place.suffix.lower() != ".fgs":
        raise InputError(f"{path}: --errors needs a .fgs file: other formats have no bits to take away")
    found = info(place)
    if not found["count"]:
        raise InputError(f"{path}: --errors: the file holds no Gaussians, so there is nothing to draw")
    run = open_run(place, options, progress, photos=False)
    views = run.seen
    chosen = views.held_out or views.train
    stored = found["settings"].get("base_psnr")
    base = stored if isinstance(stored, (int, float)) and 0.0 < stored < 200.0 else DEFAULT_BASE_PSNR
    changes = []
    with ExitStack() as stack:
        bench = stack.enter_context(open_bench(run))
        renderer = bench.renderer
        run.budget.take("the codes", COPIES * found["count"] * sum(4 * f.width(found["sh_degree"]) for f in FIELDS))
        judge = Judge(bench, run.source, views, chosen, with_photos=False, base_psnr=base)
        stack.callback(judge.close)
        with renderer.load(run.source) as original:
            judge.prepare(original, progress)
        lessers = reduced_scenes(open_fgs(place))
        for item in progress.track(lessers, "taking channels away", len(lessers)):
            saved, less = item.make()
            with renderer.load(less) as drawn:
                quality = judge.compare(drawn)
            changes.append(
                {
                    "channel": item.channel,
                    "change": item.change,
                    "bytes_saved": saved,
                    "fidelity": None if quality.fidelity is None else round(quality.fidelity, 4),
                    "modelled_drop": round(quality.modelled_drop, 6),
                }
            )
    kind = Plan.kind_of(chosen, views)
    seen = {**asdict(views_info(views)), "used": len(chosen), "kind": kind}
    return {**found, "errors": {"views": seen, "base_psnr": base, "changes": changes}}


def worth_text(found: dict[str, Any]) -> str:
    """The table of what `worth` found."""
    errors, size = found["errors"], found["size"]
    views, items = errors["views"], {(item["channel"], item["change"]): item for item in errors["changes"]}
    rows = [("", *("saves", "fidelity", "drop") * 2)]
    for channel in dict.fromkeys(item["channel"] for item in errors["changes"]):
        pair = (_cells(items.get((channel, change)), size) for change in (ONE_LESS, DROPPED))
        rows.append((channel, *(cell for cells in pair for cell in cells)))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    drawn = f"{views['used']} {views['kind']} view{'' if views['used'] == 1 else 's'}"
    lines = [
        "",
        f"what each is worth, on {drawn} of {views['cameras']}:",
        f"{'':<{widths[0]}}  {'one bit less:':<{sum(widths[1:4]) + 4}}  dropped:",
    ]
    for row in rows:
        cells = (cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True))
        lines.append("  ".join([row[0].ljust(widths[0]), *cells]))
    lines += [
        "one bit less: at twice the step. dropped: SH of this degree and higher gone; opacity, dc and scale at their mean,",
        "rotations gone. saves: bytes of the whole file. fidelity: PSNR in dB against this file's own renders; drop: the",
        f"modelled drop in dB that goes with it, from a base of {errors['base_psnr']:g} dB.",
    ]
    return "\n".join(lines) + "\n"


def _cells(item: dict[str, Any] | None, size: int) -> tuple[str, str, str]:
    if item is None:
        return "-", "-", "-"
    fidelity = "same" if item["fidelity"] is None else f"{item['fidelity']:.2f}"
    share = f"{format_size(item['bytes_saved'])} {100 * item['bytes_saved'] / size:5.1f} %"
    return share, fidelity, f"{item['modelled_drop']:.3f}"
