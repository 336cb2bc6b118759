"""`flexgs-edge study`: experiments, one module a subcommand."""

from __future__ import annotations

import click

from flexgs_edge.cli.lazy_group import LazyGroup

COMMANDS = {
    "paper": "The FlexGaussian paper's evaluation: nine experiments on the paper's method, beside its own figures.",
    "rate": "Bytes against quality: both methods at many ratios, other programs' formats, and best without each of its parts.",
    "speed": "Speed against accuracy: drawing, scoring, measuring and whole runs, and how times grow.",
    "stability": "Where methods break: bits, pruning, views, poses, far origins, generations and the searches.",
}
"""Subcommands and their line in the overview."""


@click.group(cls=LazyGroup, commands_from=("flexgs_edge.cli.study", COMMANDS))
def command() -> None:
    """Make experiments on scenes of your own: tables, charts and one page.

    Every study writes a folder: index.html with all charts, and for every experiment its rows as CSV and JSON and its chart as
    PNG and SVG. Charts need matplotlib: pip install 'flexgs-edge[charts]'.

    \b
    Examples:
      flexgs-edge study paper point_cloud.ply -o study
      flexgs-edge study rate point_cloud.ply -o rate
      flexgs-edge study speed point_cloud.ply -o speed
      flexgs-edge study stability point_cloud.ply -o stability
      flexgs-edge study paper --help
    """
