"""`flexgs-edge study rate`."""

from __future__ import annotations

from collections.abc import Callable
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


def effort_option(name: str, default: str, text: str) -> Callable[[help_page.Decorated], help_page.Decorated]:
    """A choice of effort."""
    efforts = click.Choice(["fast", "balanced", "thorough"])
    return help_page.option("Points", name, type=efforts, default=default, show_default=True, help=text)


@click.command(cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option(
    "Points",
    "--ratios",
    type=RATIOS,
    default="8,16,32,64,128,256",
    show_default=True,
    help="Ratios to the PLY that best and paper aim at.",
)
@effort_option("--effort", "balanced", "Steps of the search for these points, as for compress.")
@help_page.option(
    "Points",
    "--ablations",
    type=RATIOS,
    default="16,64",
    show_default=True,
    help="Ratios at which best is measured without each of its parts; none leaves this out.",
)
@effort_option(
    "--ablation-effort", "fast", "Steps of the search without a part, and of the whole method that it is held against."
)
@help_page.option(
    "Points",
    "--distilled",
    type=RATIOS,
    default="32,64,128",
    show_default=True,
    help="Ratios at which best is measured with --effort max as well; none leaves this out.",
)
@shared_options.study_options
def command(
    scene: str,
    output: str,
    ratios: tuple[float, ...],
    ablations: tuple[float, ...],
    ablation_effort: str,
    distilled: tuple[float, ...],
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Chart bytes against quality for a scene.

    Both methods of compress at several ratios; the whole scene as .spz, .sog and .compressed.ply, where the extra is installed
    (pip install 'flexgs-edge[formats]'); and best without each of its parts: measured costs, measuring again, the refit, the SH
    degree of each Gaussian, the context coder. Every file is judged by the same views: photos held out where there are some.

    DIR appears when everything is done: index.html, and the rows and charts of rate, fidelity and parts as CSV, JSON, PNG and
    SVG; rate.csv has all points. A scene of 200 000 Gaussians takes half an hour on two CPU cores, and some minutes more with
    points that are distilled.

    \b
    Examples:
      flexgs-edge study rate point_cloud.ply -o rate
      flexgs-edge study rate point_cloud.ply -o rate --ratios 10,20,40 --ablations none
      flexgs-edge study rate scene.ply -o rate --effort thorough --ablation-effort balanced
    """
    progress = talk.start(quiet, json_path, options["force"])
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.rate.study import study_rate

    made = CompressOptions(**options)
    result = study_rate(
        scene,
        output,
        made,
        progress,
        ratios=ratios,
        ablations=ablations,
        ablation_effort=ablation_effort,
        distilled=distilled,
    )
    talk.emit(result.to_text(), result.to_json(), json_path, options["force"])
