"""`flexgs-edge info`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("file", metavar="FILE", type=click.Path())
@shared_options.crop_option
@shared_options.write_options
def command(file: str, crop: str | None, force: bool, json_path: str | None, quiet: bool) -> None:
    """Show what a scene file holds.

    For a .fgs: Gaussians, SH degree, bits and bytes of every channel, layers, settings, and the target it reached. For other
    scene files and model folders: counts, and the cameras and photos beside them. To check every byte, use verify.

    \b
    Examples:
      flexgs-edge info scene.fgs
      flexgs-edge info scene.fgs --json - 2>/dev/null
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.info import info

    found = info(file, crop)
    talk.emit(found.summary(), found.to_json(), json_path, force)
