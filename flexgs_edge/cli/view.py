"""`flexgs-edge view`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(
    help_page.OUTPUT,
    "-o",
    "--output",
    metavar="PAGE.html|FOLDER",
    help="Write one file that opens from disk, without a network, or the folder of a web site. "
    "Default: serve the scene until Ctrl-C.",
)
@help_page.option(
    help_page.OUTPUT, "--browser/--no-browser", default=True, help="Open the page in the browser. Default: open it."
)
@help_page.option(
    help_page.OUTPUT, "--port", metavar="N", type=int, default=0, show_default="any free", help="Port of the server."
)
@help_page.option(
    help_page.OUTPUT,
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    help="Address of the server. Others than the default let other machines see the scene.",
)
@shared_options.cameras_option
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.memory_option
@shared_options.write_options
def command(
    input: str,
    output: str | None,
    browser: bool,
    port: int,
    host: str,
    force: bool,
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Look at a scene in the browser.

    The page draws the scene as render does, and lets you turn and fly through it. Cameras are a list to choose from. Nothing is
    loaded from elsewhere. With -o PAGE.html, viewer and scene become one file to mail or to keep; compress a scene first, since
    the page holds all of its bytes. With -o FOLDER, they become a web site: page, scene, a picture to show until it is there, and
    the lines that put it into another page.

    \b
    Examples:
      flexgs-edge view scene.fgs
      flexgs-edge view scene.fgs --cameras cameras.json -o scene.html
      flexgs-edge view scene.fgs -o site/
      flexgs-edge view point_cloud.ply --no-browser --port 8000
    """
    progress = talk.start(quiet, json_path, force)
    from flexgs_edge.commands.view import view
    from flexgs_edge.run.options import ViewOptions

    result = view(
        input, output, ViewOptions(**options), force, progress, host=host, port=port, browser=browser, ready=_say(quiet)
    )
    talk.emit(result.summary(), result.to_json(), json_path, force)


def _say(quiet: bool) -> Any:
    """Print the address also when the log is off: without it, nobody finds the page."""

    def say(server: Any) -> None:
        if quiet:
            from flexgs_edge.viewer.assets import PAGE

            click.echo(server.address(PAGE), err=True)

    return say
