"""`flexgs-edge info`."""

from __future__ import annotations

from typing import Any

import click
from click.core import ParameterSource

from flexgs_edge.cli import help_page, shared_options, talk
from flexgs_edge.errors import InputError


@click.command(cls=help_page.SectionCommand)
@click.argument("file", metavar="FILE", type=click.Path())
@help_page.option(
    "What channels are worth",
    "--errors",
    is_flag=True,
    help="Measure the bytes saved and the quality lost with one bit less of each channel and SH degree, and without it. "
    "Slow: draws every view many times.",
)
@help_page.option(
    "What channels are worth",
    "--picture",
    metavar="FILE",
    help="Draw what --errors measures as a .png or .svg. Needs pip install 'flexgs-edge[charts]'.",
)
@shared_options.cameras_option
@shared_options.holdout_option
@shared_options.drawing_options
@shared_options.run_options
def command(
    file: str, errors: bool, picture: str | None, force: bool, json_path: str | None, quiet: bool, **options: Any
) -> None:
    """Show what a scene file holds.

    For a .fgs: Gaussians, SH degree, bits and bytes of every channel, layers, settings, and the target it reached. For other
    scene files and model folders: counts, and the cameras and photos beside them. To check every byte, use verify.

    --errors also measures what each channel of a .fgs is worth. It draws held-out views of the cameras beside the file, or
    generated views. The options of views, memory and device are for --errors only.

    \b
    Examples:
      flexgs-edge info scene.fgs
      flexgs-edge info scene.fgs --json - 2>/dev/null
      flexgs-edge info scene.fgs --errors --picture scene.png
    """
    progress = talk.start(quiet, json_path, force)
    if not errors:
        context = click.get_current_context()
        for name in ("picture", *options):
            if context.get_parameter_source(name) is ParameterSource.COMMANDLINE:
                word = "--" + name.replace("_", "-")
                raise InputError(f"{word} is for --errors: add --errors, or leave {word} out")
        from flexgs_edge.commands.info import info

        found = info(file)
        talk.emit(found.summary(), found.to_json(), json_path, force)
        return
    from flexgs_edge.commands.worth import worth
    from flexgs_edge.run.options import ViewOptions

    if picture is not None:
        from flexgs_edge.report.worth_plot import check_picture, write_picture

        check_picture(picture, force)
    result = worth(file, ViewOptions(**options), progress)
    if picture is not None:
        write_picture(result, picture, force)
    talk.emit(result.summary(), result.to_json(), json_path, force)
