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
    help="Bytes that it may have, such as 800kB (10^3) or 1MiB (2^20): as many whole layers as fit are kept.",
)
@shared_options.write_options
def command(input: str, output: str, max_size: int, force: bool, json_path: str | None, quiet: bool) -> None:
    """Cut a layered .fgs file to a size, at the speed of copying.

    Needs neither the original nor cameras: the file's layers run from coarse to fine, and any number of the first ones is a
    valid scene. The new file says in info what it was cut from.

    \b
    Examples:
      flexgs-edge trim scene.fgs -o small.fgs --max-size 500kB
      flexgs-edge trim scene.fgs -o small.fgs --max-size 1MiB -f

    Exit code 3: not even the first layer fits.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.trim import trim, trim_text

    found = trim(input, output, max_size, force)
    talk.emit(trim_text(found), found, json_path, force)
