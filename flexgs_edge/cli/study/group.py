"""`flexgs-edge study`: experiments, one module a subcommand."""

from __future__ import annotations

import click

from flexgs_edge.cli.lazy_group import LazyGroup

COMMANDS = {
    "rate": "Chart bytes against quality for a scene.",
    "speed": "Chart the time of a run against the ratio that it finds.",
    "stability": "Find where methods break on a scene.",
}  # Subcommands and the first sentence of their help


@click.group(cls=LazyGroup, commands_from=("flexgs_edge.cli.study", COMMANDS))
def command() -> None:
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
