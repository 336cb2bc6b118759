"""`flexgs-edge synth`."""

from __future__ import annotations

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@click.argument("output", metavar="OUT.ply", type=click.Path())
@help_page.option(
    "Scene",
    "--from",
    "input",
    metavar="SCENE",
    required=True,
    help="The scene to start from: any scene file or model folder.",
)
@help_page.option(
    "Scene",
    "--gaussians",
    metavar="N",
    type=int,
    required=True,
    help="Number of Gaussians to write, at least as many as SCENE has.",
)
@help_page.option(
    "Scene",
    "--seed",
    metavar="N",
    type=int,
    default=0,
    show_default=True,
    help="Chooses which Gaussians are split into one part more than others.",
)
@shared_options.memory_option
@shared_options.write_options
def command(
    output: str,
    input: str,
    gaussians: int,
    seed: int,
    memory_limit: int | None,
    force: bool,
    json_path: str | None,
    quiet: bool,
) -> None:
    """Make a large test scene from a small one.

    Use it to test memory and time. Up to eight times the Gaussians of SCENE, each Gaussian is split into parts that look like
    it together. Beyond that, copies of the scene stand side by side in a grid: as much work, another picture. Memory does not
    grow with N. The same scene, N and seed give the same bytes.

    If SCENE has cameras, cameras.json is written beside OUT.ply. For one copy the cameras are the same. For more copies, each
    camera moves to the next copy in turn, so that every copy is seen. Such scenes have no photos.

    \b
    Examples:
      flexgs-edge synth big/point_cloud.ply --from scene/point_cloud.ply --gaussians 1000000
      flexgs-edge synth huge/point_cloud.ply --from scene.fgs --gaussians 40000000 --memory-limit 300MiB
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.synth import synth

    result = synth(output, input, gaussians, seed, force, memory_limit)
    talk.emit(result.summary(), result.to_json(), json_path, force)
