"""`flexgs-edge study paper`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("scenes", metavar="SCENE...", type=click.Path(), nargs=-1, required=True)
@shared_options.results_option
@help_page.option(
    "Search",
    "--max-drop",
    metavar="DB",
    type=float,
    default=1.0,
    show_default=True,
    help="Drop that the search on the plane of the rates aims at: against the photos where there are photos, else modelled.",
)
@shared_options.study_options
def command(scenes: tuple[str, ...], output: str, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Make the FlexGaussian paper's evaluation on your own scenes.

    Nine experiments a scene: plain rounding at 2 to 8 bits; each attribute alone at 4 and 8; pruning of Gaussians and SH
    against either alone at equal bytes; the plane of the two rates with the search on it; pruning, quantization and both;
    sub-groups; the two scores; rate and distortion from 8x to 256x; time and memory. The paper's figures stand beside.

    SCENE is what compress takes as INPUT; --cameras and --images count for all scenes given. DIR appears when everything is
    done: index.html, and a folder a scene with the rows of every experiment as CSV and JSON and its chart as PNG and SVG. All
    but the times is the same in every run.

    \b
    Examples:
      flexgs-edge study paper point_cloud.ply -o study
      flexgs-edge study paper output/garden output/room -o study --resolution 800
      flexgs-edge study paper scene.ply -o study --cameras cameras.json --images none
          without photos: the modelled drop decides
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.paper.study import study_paper

    result = study_paper(scenes, output, CompressOptions(**options), progress)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
