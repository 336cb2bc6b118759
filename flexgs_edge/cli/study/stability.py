"""`flexgs-edge study stability`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option("Points", "--quick", is_flag=True, help="Fewer points and small views: much faster, less exact.")
@shared_options.study_target_option
@shared_options.study_options
def command(scene: str, output: str, quick: bool, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Find where methods break on a scene.

    \b
      heldout, distance,     the worst view; cameras nearer, farther, between
      poses                  and above the path; other lenses and sizes

    Compares best, best by the mean alone, and paper. A method breaks where it
    loses far too much PSNR. Results appear in DIR when all is done: open DIR/index.html.

    \b
    Examples:
      flexgs-edge study stability point_cloud.ply -o stability
      flexgs-edge study stability point_cloud.ply -o stability --quick
      flexgs-edge study stability scene.ply -o stability --max-drop 0.5
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.stability import study_stability

    result = study_stability(scene, output, CompressOptions(**options), progress, quick=quick)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
