"""`flexgs-edge trim`."""

from __future__ import annotations

import click

from flexgs_edge.cli import shared_options, talk, value_types


@click.command(cls=shared_options.SectionCommand)
@click.argument("input", metavar="IN.fgs", type=click.Path())
@shared_options.option("Output", "-o", "--output", metavar="OUT.fgs", required=True, help="File to write.")
@shared_options.option(
    "Output",
    "--max-size",
    type=value_types.SIZE,
    required=True,
    help="Bytes that it may have, such as 800kB (10^3) or 1MiB (2^20): as many whole layers as fit are kept.",
)
@shared_options.force_option
@shared_options.json_option
@shared_options.talk_options
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
