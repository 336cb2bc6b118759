"""`flexgs-edge study`: charts of a user's own scenes."""

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk, value_types
from flexgs_edge.cli.help_page import LazyGroup
from flexgs_edge.progress import Progress
from flexgs_edge.report.run_info import Result

COMMANDS = {
    "rate": "Chart bytes against quality for a scene.",
    "speed": "Chart the time of a run against the ratio that it finds.",
    "stability": "Find where methods break on a scene.",
}  # Subcommands and the first sentence of their help


@click.group(cls=LazyGroup, modules=("flexgs_edge.cli.study",), lines=COMMANDS)
def study() -> None:
    """Run experiments on your own scenes: tables and charts.

    A study writes a folder: index.html with all charts, the rows of every experiment as CSV and JSON, and its chart as PNG and
    SVG. Charts need pip install 'flexgs-edge[charts]'. Studies draw and compress a scene many times: expect long runs.

    \b
    Examples:
      flexgs-edge study rate point_cloud.ply -o rate
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study stability point_cloud.ply -o stability
      flexgs-edge study rate --help
    """


@click.command("rate", cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option(
    "Points",
    "--ratios",
    type=value_types.RATIOS,
    default="8,16,32,64,128,256",
    help="Ratios to the .ply that both methods aim at.",
)
@help_page.option(
    "Points",
    "--effort",
    type=click.Choice(["fast", "balanced"]),
    default="balanced",
    help="Effort of the search at these ratios, as for compress.",
)
@shared_options.study_options
@talk.told
def rate(scene: str, output: str, ratios: tuple[float, ...], force: bool, progress: Progress, **options: Any) -> Result:
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
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.rate import study_rate

    return study_rate(scene, output, CompressOptions(force=force, **options), progress, ratios=ratios)


@click.command("speed", cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@shared_options.study_target_option
@shared_options.study_options
@talk.told
def speed(scene: str, output: str, force: bool, progress: Progress, **options: Any) -> Result:
    """Chart the time of a run against the ratio that it finds.

    Compresses the scene by each method and effort. Results appear in DIR when all is done: open DIR/index.html. Times are
    those of this machine: close other programs.

    \b
    Examples:
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study speed scene.ply -o speed --max-drop 0.5 --resolution 800
    """
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.speed import study_speed

    return study_speed(scene, output, CompressOptions(force=force, **options), progress)


@click.command("stability", cls=help_page.SectionCommand)
@click.argument("scene", metavar="SCENE", type=click.Path())
@shared_options.results_option
@help_page.option("Points", "--quick", is_flag=True, help="Fewer points and small views: much faster, less exact.")
@shared_options.study_target_option
@shared_options.study_options
@talk.told
def stability(scene: str, output: str, quick: bool, force: bool, progress: Progress, **options: Any) -> Result:
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
    from flexgs_edge.run.options import CompressOptions
    from flexgs_edge.studies.stability import study_stability

    return study_stability(scene, output, CompressOptions(force=force, **options), progress, quick=quick)
