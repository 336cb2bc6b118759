"""`flexgs-edge study speed`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


class PartsType(click.ParamType):
    """Parts: `drawing,scoring`; which there are, the library knows."""

    name = "LIST"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[str, ...]:
        if isinstance(value, tuple):
            return value
        return tuple(part.strip() for part in value.split(","))


PARTS = PartsType()


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option(
    "Parts",
    "--parts",
    type=PARTS,
    default="drawing,scoring,presets",
    show_default=True,
    help="What to measure. Fewer parts are faster.",
)
@help_page.option(
    "Parts",
    "--repeats",
    metavar="N",
    type=int,
    default=5,
    show_default=True,
    help="Repeats of each timing; the shortest counts. More is slower, more exact.",
)
@help_page.option(
    "Parts",
    "--max-drop",
    metavar="DB",
    type=float,
    default=1.0,
    show_default=True,
    help="Loss of PSNR that whole runs aim at.",
)
@shared_options.study_options
def command(
    scene: str,
    output: str,
    parts: tuple[str, ...],
    repeats: int,
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Chart speed against accuracy for a scene.

    \b
      drawing   time of a view against its PSNR to the exact one: fewer SH,
                faint splats left out, half precision, small pictures
      scoring   time of scoring against the quality at one size, by the
                number of views scored
      presets   time of whole runs of compress against the ratio reached

    Results appear in DIR when all is done: open DIR/index.html. Times are those of this machine: close other programs.

    \b
    Examples:
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study speed point_cloud.ply -o speed --parts drawing,scoring
      flexgs-edge study speed scene.ply -o speed --max-drop 0.5 --resolution 800
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.speed.study import study_speed

    made = CompressOptions(**options)
    result = study_speed(scene, output, made, progress, parts=parts, repeats=repeats)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
