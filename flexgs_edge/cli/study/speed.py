"""`flexgs-edge study speed`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@shared_options.study_target_option
@shared_options.study_options
def command(scene: str, output: str, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Chart the time of a run against the ratio that it finds.

    Compresses the scene by each method and effort. Results appear in DIR when all is done: open DIR/index.html. Times are
    those of this machine: close other programs.

    \b
    Examples:
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study speed scene.ply -o speed --max-drop 0.5 --resolution 800
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.speed import study_speed

    result = study_speed(scene, output, CompressOptions(**options), progress)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
