"""`flexgs-edge study stability`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option(
    "Points",
    "--quick",
    is_flag=True,
    help="Few points of every experiment, on views 120 pixels wide: a minute in place of a quarter of an hour.",
)
@help_page.option(
    "Points",
    "--max-drop",
    metavar="DB",
    type=float,
    default=1.0,
    show_default=True,
    help="Target of the results that are moved, looked at from elsewhere and compressed again.",
)
@shared_options.study_options
def command(scene: str, output: str, quick: bool, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Chart where methods break on a scene, and where ours stops standing.

    \b
    bits, groups, strays   fewer bits, other groups and orders of rows, stray values
    pruning, views, halves more removed, in eight ways; scores from few views, or
                           from one side
    heldout, distance,     the worst view; poses nearer, farther, between and above
    poses                  the path, other lenses and sizes; the worst tile
    moves                  far from the origin, other units, turned
    generations            compressed again and again; two targets in a row
    search                 the searches on rough, flat and noisy curves

    best, paper and simple baselines: plain rounding, removing Gaussians or SH alone, simple scores. A method has broken where it
    loses more than 3 dB, or ends in an error. DIR appears when everything is done: index.html, and every experiment's rows and
    chart as CSV, JSON, PNG and SVG. A scene of 200 000 Gaussians takes a quarter of an hour on two CPU cores.

    \b
    Examples:
      flexgs-edge study stability point_cloud.ply -o stability
      flexgs-edge study stability point_cloud.ply -o stability --quick
      flexgs-edge study stability scene.ply -o stability --max-drop 0.5
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.stability.study import study_stability

    result = study_stability(scene, output, CompressOptions(**options), progress, quick=quick)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
