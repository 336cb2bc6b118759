"""`flexgs-edge views`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(help_page.OUTPUT, "-o", "--output", metavar="SHEET.png", required=True, help="The PNG file.")
@shared_options.cameras_option
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
def command(input: str, output: str, force: bool, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Draw all views of a scene on one sheet.

    It shows at a glance where views stand, above all those that are placed automatically for a scene without cameras. Views with
    a star are held out: they decide.

    \b
    Examples:
      flexgs-edge views point_cloud.ply -o sheet.png
      flexgs-edge views point_cloud.ply -o sheet.png --cameras auto
    """
    progress = talk.start(quiet, json_path, force)
    from flexgs_edge.commands.views import draw_sheet
    from flexgs_edge.run.options import ViewOptions

    result = draw_sheet(input, output, ViewOptions(**options), force, progress)
    talk.emit(result.summary(), result.to_json(), json_path, force)
