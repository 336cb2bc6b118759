"""`flexgs-edge trim`."""

from __future__ import annotations

import click

from flexgs_edge.cli import words


@click.command(cls=words.SectionCommand)
@click.argument("input", metavar="IN.fgs", type=click.Path())
@words.option("Output", "-o", "--output", metavar="OUT.fgs", required=True, help="File to write.")
@words.option(
    "Output",
    "--max-size",
    type=words.SIZE,
    required=True,
    help="Bytes that it may have, such as 800kB (10^3) or 1MiB (2^20): as many whole layers as fit are kept.",
)
@words.force_option
@words.json_option
@words.talk_options
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
    words.start(quiet, json_path, force)
    from flexgs_edge.pipeline.trim import trim, trim_text

    found = trim(input, output, max_size, force)
    words.emit(trim_text(found), found, json_path, force)
