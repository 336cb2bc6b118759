"""`flexgs-edge study paper`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("scenes", metavar="SCENE...", type=click.Path(), nargs=-1, required=True)
@shared_options.results_option
@shared_options.study_target_option
@shared_options.study_options
def command(scenes: tuple[str, ...], output: str, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Repeat the FlexGaussian paper's experiments on your scenes.

    All use --method paper. The paper's own figures stand beside the results.

    \b
      rtn         plain rounding at 2 to 8 bits
      attributes  each attribute alone at 4 and at 8 bits
      splits      removing Gaussians, SH, or both, at equal bytes
      plane       the plane of the two rates, and the search on it
      parts       removal only, quantization only, both
      groups      with and without sub-groups
      scores      the two ways to score Gaussians
      rates       quality at ratios from 8x to 256x
      times       time and memory

    SCENE is an INPUT of compress. --cameras and --images hold for all scenes. Results appear in DIR when all is done: open
    DIR/index.html. All but the times is the same in every run.

    \b
    Examples:
      flexgs-edge study paper point_cloud.ply -o study
      flexgs-edge study paper output/garden output/room -o study --resolution 800
      flexgs-edge study paper scene.ply -o study --cameras cameras.json --images none
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.paper.study import study_paper

    result = study_paper(scenes, output, CompressOptions(**options), progress)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
