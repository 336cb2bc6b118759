"""`flexgs-edge study rate`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


class RatiosType(click.ParamType):
    """Ratios: `8,16,32`, or none."""

    name = "LIST"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, ...]:
        if isinstance(value, tuple):
            return value
        if value.strip().lower() == "none":
            return ()
        try:
            return tuple(float(part) for part in value.split(","))
        except ValueError:
            self.fail(f"{value!r}: expected ratios such as 8,16,32, or none", param, ctx)


RATIOS = RatiosType()


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option(
    "Points", "--ratios", type=RATIOS, default="8,16,32,64,128,256", help="Ratios to the .ply that both methods aim at."
)
@help_page.option(
    "Points",
    "--effort",
    type=click.Choice(["fast", "balanced"]),
    default="balanced",
    help="Effort of the search at these ratios, as for compress.",
)
@shared_options.study_options
def command(
    scene: str, output: str, ratios: tuple[float, ...], json_path: str | None, quiet: bool, **options: Any
) -> None:
    """Chart bytes against quality for a scene.

    \b
      - both methods of compress, at several ratios
      - the whole scene as .spz, .sog and .compressed.ply

    The same views judge every file: held-out photos where there are some. Results appear in DIR when all is done: open
    DIR/index.html; rate.csv has all points. More ratios and more effort take longer.

    \b
    Examples:
      flexgs-edge study rate point_cloud.ply -o rate
      flexgs-edge study rate point_cloud.ply -o rate --ratios 10,20,40
      flexgs-edge study rate scene.ply -o rate --effort fast
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.rate import study_rate

    made = CompressOptions(**options)
    result = study_rate(scene, output, made, progress, ratios=ratios)
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
