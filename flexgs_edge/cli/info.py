"""`flexgs-edge info`."""

from __future__ import annotations

import click

from flexgs_edge.cli import words


@click.command(cls=words.SectionCommand)
@click.argument("file", metavar="FILE", type=click.Path())
@words.force_option
@words.json_option
@words.talk_options
def command(file: str, force: bool, json_path: str | None, quiet: bool) -> None:
    """Show what a scene file holds.

    For a .fgs: Gaussians, SH degree, bits and bytes of every channel and SH degree, layers, the settings it was made with
    and the target it reached (files of --method best are decoded for this; use verify to check every byte). For other
    scene files and model folders: counts, and what lies beside it.

    \b
    Examples:
      flexgs-edge info scene.fgs
      flexgs-edge info scene.fgs --json - 2>/dev/null
    """
    words.start(quiet, json_path, force)
    from flexgs_edge.pipeline.info import info, info_text

    found = info(file)
    words.emit(info_text(found), found, json_path, force)
