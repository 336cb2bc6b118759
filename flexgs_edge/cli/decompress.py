"""`flexgs-edge decompress`."""

from __future__ import annotations

import click

from flexgs_edge.cli import words


@click.command(cls=words.SectionCommand)
@click.argument("input", metavar="IN.fgs", type=click.Path())
@words.option("Output", "-o", "--output", metavar="OUT.ply", required=True, help="PLY to write.")
@words.memory_option
@words.force_option
@words.json_option
@words.talk_options
def command(input: str, output: str, memory_limit: int | None, force: bool, json_path: str | None, quiet: bool) -> None:
    """Decode a .fgs file to a PLY that every viewer opens.

    The PLY has INRIA's layout: x y z, normals (zero), colours, opacity, scales and rotations as 32-bit floats, little endian.
    Gaussians that lost their SH above degree 0 get zeros there. Decoding is exact: the same bits on every machine.

    \b
    Examples:
      flexgs-edge decompress scene.fgs -o scene.ply
      flexgs-edge decompress scene.fgs -o scene.ply -f --memory-limit 200MiB
    """
    words.start(quiet, json_path, force)
    from flexgs_edge.pipeline.decompress import decompress
    from flexgs_edge.report.summary import decompress_text

    result = decompress(input, output, force, memory_limit)
    words.emit(decompress_text(result), result.to_json(), json_path, force)
