"""`flexgs-edge render`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk, value_types


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(
    help_page.OUTPUT, "-o", "--output", metavar="DIR", required=True, help="Folder for the PNG files; made if missing."
)
@shared_options.cameras_option
@help_page.option(
    help_page.VIEWS,
    "--views",
    type=value_types.VIEWS,
    help="Views to draw, counted from 0 in order of name: a list such as 0,8,16, or START:STOP:STEP such as 0:50:8. "
    "Default: all.",
)
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
def command(
    input: str, output: str, views: list[int] | None, force: bool, json_path: str | None, quiet: bool, **options: Any
) -> None:
    """Draw views of a scene as PNG files.

    The files are named after the cameras. A .fgs says how it is drawn: near plane, background and antialiasing.
    Options override that. The summary shows the median time of a view, without start-up and without writing files.

    \b
    Examples:
      flexgs-edge render scene.fgs -o views --cameras cameras.json
      flexgs-edge render point_cloud.ply -o views --views 0:50:8 --background white
      flexgs-edge render scene.fgs -o views --cameras cameras.json --views 0 --json - 2>/dev/null
    """
    progress = talk.start(quiet, json_path, force)
    from flexgs_edge.commands.render import render_views
    from flexgs_edge.run.options import ViewOptions

    result = render_views(input, output, ViewOptions(**options), views, force, progress)
    talk.emit(result.summary(), result.to_json(), json_path, force)
