"""`flexgs-edge score`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(help_page.OUTPUT, "-o", "--output", metavar="SCORES.npz", required=True, help="NumPy file to write.")
@help_page.option(
    "Score",
    "--score",
    type=click.Choice(["gs", "meson"]),
    default="gs",
    help="gs: opacity * volume^0.1 * pixels hit. meson: volume^0.1 * summed weights.",
)
@shared_options.photos_options
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
def command(
    input: str, output: str, score: str, force: bool, json_path: str | None, quiet: bool, **options: Any
) -> None:
    """Save the importance of every Gaussian, for --method paper.

    The training views are drawn to score the Gaussians. `compress --method paper --score-cache FILE` with the same scene,
    views and score then skips scoring. The file holds one float64 for each Gaussian, in the scene's order: the logarithm of the
    score, or -inf if no training view sees it. Photos are not compared. Photos smaller than the cameras say scale the views down.

    \b
    Examples:
      flexgs-edge score point_cloud.ply -o scores.npz
      flexgs-edge compress point_cloud.ply -o scene.fgs --method paper --score-cache scores.npz --max-drop 0.5
    """
    progress = talk.start(quiet, json_path, force)
    from flexgs_edge.commands.score import score_gaussians
    from flexgs_edge.run.options import ViewOptions

    result = score_gaussians(input, output, ViewOptions(**options), score, force, progress)
    talk.emit(result.summary(), result.to_json(), json_path, force)
