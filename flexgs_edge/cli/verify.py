"""`flexgs-edge verify`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk
from flexgs_edge.errors import FormatError


@click.command(cls=help_page.SectionCommand)
@click.argument("file", metavar="FILE.fgs", type=click.Path())
@shared_options.write_options
def command(file: str, force: bool, json_path: str | None, quiet: bool) -> None:
    """Check every byte of a .fgs file against its checksums.

    Lists the parts of the file and marks the damaged ones. Reads the file in pieces: a large file needs no more memory.

    \b
    Examples:
      flexgs-edge verify scene.fgs
      flexgs-edge verify scene.fgs -q > /dev/null && echo whole

    Exit code 0: every part is whole. Exit code 2: something is damaged.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.verify import verify

    result = verify(file)
    talk.emit(result.summary(), result.to_json(), json_path, force)
    if not result.ok:
        raise FormatError(f"{file}: damaged: {', '.join(result.damaged)}; get the file again from where it came from")
