"""`flexgs-edge verify`."""

from __future__ import annotations

import click

from flexgs_edge.cli import words
from flexgs_edge.errors import FormatError


@click.command(cls=words.SectionCommand)
@click.argument("file", metavar="FILE.fgs", type=click.Path())
@words.force_option
@words.json_option
@words.talk_options
def command(file: str, force: bool, json_path: str | None, quiet: bool) -> None:
    """Check every byte of a .fgs file against its checksums.

    Names every part with its place, and those that are damaged. Reads the file in pieces, so any size will do.

    \b
    Examples:
      flexgs-edge verify scene.fgs
      flexgs-edge verify scene.fgs -q > /dev/null && echo whole

    Exit code 0: every part is whole. 2: something is damaged.
    """
    words.start(quiet, json_path, force)
    from flexgs_edge.pipeline.contents import verify, verify_json, verify_text

    sections = verify(file)
    words.emit(verify_text(file, sections), verify_json(file, sections), json_path, force)
    damaged = [section.name for section in sections if not section.ok]
    if damaged:
        raise FormatError(f"{file}: damaged: {', '.join(damaged)}; get the file again from where it came from")
