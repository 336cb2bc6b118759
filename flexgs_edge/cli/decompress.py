"""`flexgs-edge decompress`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("input", metavar="INPUT", type=click.Path())
@help_page.option(
    help_page.OUTPUT,
    "-o",
    "--output",
    metavar="OUT",
    required=True,
    help="File to write: .ply, .spz, .sog, .compressed.ply, .splat, .glb, .usd, .usda, .usdc, .usdz, or FOLDER/lod-meta.json "
    "(streamed SOG).",
)
@shared_options.positions_options
@shared_options.writing_options
@help_page.option(
    help_page.OUTPUT,
    "--double",
    is_flag=True,
    help="Write x y z of a .ply as doubles, which not every program reads. Default: the type that came in. A .fgs does not keep "
    "it: floats, unless they would ruin a scene far from zero.",
)
@help_page.option(
    help_page.VIEWS,
    "--cameras",
    metavar="PATH",
    help="Cameras of the pictures that show what another program's format loses. none: no pictures. Default: cameras beside "
    "the scene, else generated views (with --device numpy: none).",
)
@shared_options.reading_options
@help_page.option(
    help_page.DEVICE,
    "--device",
    metavar="SPEC",
    help="Device that draws the compared pictures; an OpenCL CPU also decodes a large .fgs of --method best. Its number, part "
    "of its name, or cpu. numpy: the same bits, slower. Default: as `devices` says, and a CPU for large files.",
)
@shared_options.memory_option
@shared_options.write_options
def command(
    input: str,
    output: str,
    recenter: bool,
    force_lossy: bool,
    spz_version: int,
    glb: str,
    double: bool,
    cameras: str | None,
    frame: str | None,
    lod: int | None,
    sh_degree: int | None,
    crop: str | None,
    device: str | None,
    memory_limit: int | None,
    force: bool,
    json_path: str | None,
    quiet: bool,
) -> None:
    """Decode a .fgs file to a .ply, or convert between formats.

    INPUT is a .fgs, .ply, .spz, .sog or .compressed.ply file, or a model folder. Decoding a .fgs is exact: the same bits on
    every machine.

    A .ply has INRIA's layout: x y z, normals (zero), colours, opacity, scales and rotations, as 32-bit floats (--double: x y z
    as 64-bit ones), little endian. Gaussians without view-dependent colour get zeros for it.

    Formats of other programs round values in their own ways. What that loses is measured and printed. To make such a file
    smaller, use compress.

    FOLDER/lod-meta.json is streamed SOG, which PlayCanvas and SuperSplat load step by step: each layer of a .fgs of compress
    --layers becomes a level of detail.

    \b
    Examples:
      flexgs-edge decompress scene.fgs -o scene.ply
      flexgs-edge decompress scene.fgs -o scene.ply -f --memory-limit 200MiB
      flexgs-edge decompress scene.fgs -o scene.spz
      flexgs-edge decompress scene.sog -o scene.ply
      flexgs-edge decompress layered.fgs -o streamed/lod-meta.json
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.decompress import decompress
    from flexgs_edge.io.reading import Reading, Writing

    reading = Reading.of(frame, lod, sh_degree, crop)
    writing = Writing(spz_version, force_lossy=force_lossy, glb=glb, double=double)
    result = decompress(input, output, force, memory_limit, device, reading, writing, recenter, cameras)
    talk.emit(result.summary(), result.to_json(), json_path, force)
