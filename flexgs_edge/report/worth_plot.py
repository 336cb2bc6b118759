"""Draw the picture of `info --errors`: what each channel of a file is worth."""

from __future__ import annotations

from pathlib import Path

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, check_writable
from flexgs_edge.report.plots import DotChart, picture, require_matplotlib
from flexgs_edge.report.worth_result import WorthResult

SUFFIXES = (".png", ".svg")


def check_picture(path: str, force: bool) -> None:
    """Raise `InputError` if the picture cannot be written. Call this before any work starts."""
    if Path(path).suffix.lower() not in SUFFIXES:
        raise InputError(f"--picture {path}: expected a name that ends in {' or '.join(SUFFIXES)}")
    require_matplotlib()
    check_writable(path, force)


def write_picture(found: WorthResult, path: str, force: bool) -> None:
    """Draw a dot for each change: its modelled drop, and the share of the file's bytes that it saves."""
    png, svg = picture(worth_chart(found))
    with atomic_write(path, force) as file:
        file.write(png if Path(path).suffix.lower() == ".png" else svg)


def worth_chart(found: WorthResult) -> DotChart:
    """Return the chart as a record."""
    changes, size = found.changes, found.info.size
    groups = list(dict.fromkeys(item.channel for item in changes))
    kinds = list(dict.fromkeys(item.change for item in changes))
    by = {(item.channel, item.change): item for item in changes}
    name = Path(found.info.path).name
    return DotChart(
        title=f"{name}: what each channel is worth, beside it the share of the bytes that it saves",
        y_label="modelled drop, dB",
        groups=groups,
        dots={kind: [by[g, kind].modelled_drop if (g, kind) in by else None for g in groups] for kind in kinds},
        words={
            kind: [f"{100 * by[g, kind].bytes_saved / size:.1f} %" if (g, kind) in by else "" for g in groups]
            for kind in kinds
        },
    )
