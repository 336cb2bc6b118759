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
    default="drawing,scoring,sampling,presets,scaling",
    show_default=True,
    help="What to measure.",
)
@help_page.option(
    "Parts", "--repeats", type=int, default=5, show_default=True, help="Rounds of timing; the least counts."
)
@help_page.option(
    "Parts", "--trials", type=int, default=200, show_default=True, help="Samples of tiles of every size, for sampling."
)
@help_page.option(
    "Parts",
    "--max-drop",
    metavar="DB",
    type=float,
    default=1.0,
    show_default=True,
    help="Target of the whole runs, and of the paper's search that scoring and sampling build on.",
)
@shared_options.study_options
def command(
    scene: str,
    output: str,
    parts: tuple[str, ...],
    repeats: int,
    trials: int,
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Chart speed against accuracy for a scene.

    \b
    drawing   time of a view against its PSNR to the exact one: fewer SH, splats
              left out by opacity, extents, half precision, small pictures
    scoring   time of scoring against what it is worth at one size, by the number
              of views scored; and how stable the ranks are
    sampling  fidelity estimated from a part of the tiles, with its interval
    presets   time of whole runs of compress against the ratio that they find
    scaling   how times grow with Gaussians, pixels and views

    DIR appears when everything is done: index.html, and every part's rows and chart as CSV, JSON, PNG and SVG. Times are those of
    this machine; close other programs.

    \b
    Examples:
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study speed point_cloud.ply -o speed --parts drawing,scaling
      flexgs-edge study speed scene.ply -o speed --max-drop 0.5 --resolution 800
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.speed.study import study_speed

    made = CompressOptions(**options)
    result = study_speed(scene, output, made, progress, parts=parts, repeats=repeats, trials=trials)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
