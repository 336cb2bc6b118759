"""`flexgs-edge trim`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk, value_types


@click.command(cls=help_page.SectionCommand)
@click.argument("input", metavar="IN.fgs", type=click.Path())
@help_page.option(help_page.OUTPUT, "-o", "--output", metavar="OUT.fgs", required=True, help="File to write.")
@help_page.option(
    help_page.OUTPUT,
    "--max-size",
    type=value_types.SIZE,
    required=True,
    help="Largest size of the new file, such as 800kB or 1MiB.",
)
@shared_options.write_options
def command(input: str, output: str, max_size: int, force: bool, json_path: str | None, quiet: bool) -> None:
    """Cut a layered .fgs file to a size, without the original.

    compress --layers writes layers, from coarse to fine. trim keeps as many of the first layers as fit. The result is a valid
    scene, and info says what it was cut from. This takes as long as copying the file.

    \b
    Examples:
      flexgs-edge trim scene.fgs -o small.fgs --max-size 500kB
      flexgs-edge trim scene.fgs -o small.fgs --max-size 1MiB -f

    Where not even the first layer fits, the new file is the preview, if there is one.

    Exit code 3: nothing fits.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.trim import trim

    result = trim(input, output, max_size, force)
    talk.emit(result.summary(), result.to_json(), json_path, force)
