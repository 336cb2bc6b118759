"""`flexgs-edge compress`."""

from __future__ import annotations

from typing import Any

import click
from click.core import ParameterSource

from flexgs_edge.cli import shared_options, talk, value_types


@click.command(cls=shared_options.SectionCommand)
@shared_options.scene_argument
@shared_options.option(
    "Output",
    "-o",
    "--output",
    metavar="OUT",
    help="File to write: .fgs, .spz, .sog or .compressed.ply (a .fgs needs none with --dry-run).",
)
@shared_options.option("Output", "--dry-run", is_flag=True, help="Do everything but write; the size shown is exact.")
@shared_options.report_option
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--max-drop",
    metavar="DB",
    type=float,
    help="Fewest bytes that lose at most so many dB of PSNR: against the photos where there are photos, else modelled.",
)
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--min-fidelity",
    metavar="DB",
    type=float,
    help="Fewest bytes whose renders keep a PSNR of at least so many dB against the original's renders (40: about 1 dB of drop).",
)
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--max-worst-drop",
    metavar="DB",
    type=float,
    help="With --max-drop or --min-fidelity: no deciding view may lose more than this either.",
)
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--max-size",
    type=value_types.SIZE,
    help="Best quality in a file of at most so many bytes, such as 8MB (10^6) or 8MiB (2^20).",
)
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--min-ratio",
    metavar="R",
    type=float,
    help="Best quality in a file R times smaller than the PLY (248 bytes a Gaussian at SH degree 3).",
)
@shared_options.option(
    "Target (one of them; default --max-drop 1.0)",
    "--best-effort",
    is_flag=True,
    help="Write the closest point when the target cannot be met (exit code 0 then, not 3).",
)
@shared_options.photos_options
@shared_options.select_option
@shared_options.drawing_options
@shared_options.option(
    "Method",
    "--method",
    type=click.Choice(["best", "paper"]),
    default="best",
    show_default=True,
    help="best: measured removal costs, colour refit and an entropy coder. paper: FlexGaussian's, bit-packed without entropy "
    "coding: four to six times the bytes at the same drop, in a fraction of the seconds.",
)
@shared_options.option(
    "Method",
    "--unseen",
    metavar="keep|drop|N%",
    default="keep",
    show_default=True,
    help="Gaussians that no training pose sees (best only): kept without SH, dropped, or the largest N % of them kept.",
)
@shared_options.option(
    "Views",
    "--views-margin",
    is_flag=True,
    help="Make three poses of every two given ones and score them too (best only): nearer to what is seen, farther from it and "
    "in between, so that what only such views show stays.",
)
@shared_options.option(
    "Method", "--refit/--no-refit", default=True, help="Refit colours to what was pruned and quantized (best only)."
)
@shared_options.option(
    "Method",
    "--layers",
    metavar="N",
    type=int,
    default=1,
    show_default=True,
    help="Up to 4 layers that each double the bytes (best only): `trim` then cuts the file to a size without the original.",
)
@shared_options.option(
    "Run",
    "--scratch",
    metavar="DIR",
    help="Folder for scratch files, used when a scene does not fit into the memory limit (best only). Default: beside OUT.",
)
@shared_options.option(
    "Run",
    "--resume",
    is_flag=True,
    help="Keep every round of the search in the scratch folder until the run is done, and go on from those of a run of the same "
    "scene, poses and options that was cut short (best only): the bytes are those of one run.",
)
@shared_options.option(
    "Run",
    "--cluster",
    metavar="ADDRESS|local:N",
    help="Draw the scored poses and the views that are compared on a Dask cluster, such as tcp://HOST:8786, or in N processes "
    "here (best only; needs pip install 'flexgs-edge[cluster]'). The bytes are those of one machine.",
)
@shared_options.option(
    "Method",
    "--score",
    metavar="gs|meson|FILE",
    default="gs",
    show_default=True,
    help="Importance of Gaussians (paper only): gs (opacity, volume, pixels hit), meson (MesonGS), or a .npy/.npz file with a "
    "number each.",
)
@shared_options.option(
    "Method",
    "--save-scores",
    metavar="FILE",
    help="Write the scores (paper only) to a .npy file, for --score in later runs.",
)
@shared_options.option(
    "Method",
    "--score-cache",
    metavar="FILE",
    help="Keep the scores (paper only) in FILE; a later run takes them if scene, poses and score are the same, else makes them "
    "anew.",
)
@shared_options.option(
    "Method",
    "--prune-rate",
    metavar="P",
    type=float,
    help="Remove this share of the Gaussians, from 0 to 1: with --sh-rate, instead of a search (paper only).",
)
@shared_options.option(
    "Method",
    "--sh-rate",
    metavar="S",
    type=float,
    help="Take the SH above degree 0 from this further share of the Gaussians, from 0 to 1 (paper only).",
)
@shared_options.option(
    "Method",
    "--bits",
    metavar="SPEC",
    default="paper",
    show_default=True,
    help="Bits for each value (paper only): paper (xyz=16, dc=8, scale=8, rot=8, opacity=4, rest=4), what shall differ from it, "
    "such as rest=3,dc=7, auto (sensitivity search), or rtn8, rtn4, ... (one width for all, one range a channel: the "
    "baseline that fails).",
)
@shared_options.option(
    "Method",
    "--groups",
    metavar="N",
    type=int,
    help="Ranges for each channel (paper only; there 1000). Default: one for about 512 Gaussians.",
)
@shared_options.base_psnr_option
@shared_options.option(
    "Method",
    "--effort",
    type=click.Choice(["fast", "balanced", "thorough", "max"]),
    default="balanced",
    show_default=True,
    help="Steps of the search: best 1, 2 or 5 whole results, with more rounds and poses each; paper 4, 10 or 32 after its "
    "list (other formats: 4, 6 or 10 files). max: as balanced, with --distil (.fgs only). Counted, never timed: same command, "
    "same bytes.",
)
@shared_options.option(
    "Method",
    "--distil",
    metavar="STEPS",
    type=int,
    help="Move all that is kept towards the original's own renders (no photos), one view a step; 0: do not (best, .fgs only). "
    "Default: 10 steps a scored pose with --effort max, else none.",
)
@shared_options.drop_invalid_option
@shared_options.run_options
def command(input: str, output: str | None, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Compress a scene: the fewest bytes that hold a quality, or the best quality in a size.

    INPUT is a .ply in INRIA's layout, a .fgs, .spz, .sog or .compressed.ply, or a model folder of the 3DGS training program.
    Cameras and an images/ folder beside it are used and named in the summary; a lone scene gets views made from itself.
    The training poses tell what each Gaussian is worth; then a search finds which to remove, which lose their view-dependent
    colour and how finely the rest is kept, and measures each step by rendering. The figures in the summary are measured on
    the finished file. With -o OUT.spz, .sog or .compressed.ply every step writes that format and measures what it decodes to,
    so its own losses count.

    \b
    Examples:
      flexgs-edge compress point_cloud.ply -o scene.fgs
          at most 1 dB worse against the photos
      flexgs-edge compress output/garden -o garden.fgs --images data/garden/images_4 --max-drop 0.5
          a model folder with photos elsewhere
      flexgs-edge compress point_cloud.ply -o scene.fgs --max-size 8MB
          the best that fits
      flexgs-edge compress point_cloud.ply -o scene.fgs --effort fast
          three fifths of the seconds, 7 to 32 % more bytes (a sample scene, a real one)
      flexgs-edge compress point_cloud.ply -o scene.fgs --effort max
          a third fewer bytes, in about twice the time
      flexgs-edge compress point_cloud.ply -o a.fgs --method paper --score-cache s.npz
      flexgs-edge compress point_cloud.ply -o b.fgs --method paper --score-cache s.npz --max-drop 2
          the paper's method: score once, then try another target
      flexgs-edge compress point_cloud.ply -o scene.fgs --method paper --prune-rate 0.3 --sh-rate 0.4
          fixed rates, no search
      flexgs-edge compress point_cloud.ply -o scene.spz --max-drop 0.5
          for viewers of that format (needs pip install 'flexgs-edge[formats]')

    Exit code 3 says that the target cannot be met, and names the closest point.
    """
    progress = talk.start(quiet, json_path, options["force"], options["report"])
    from flexgs_edge.commands.compress import compress
    from flexgs_edge.report.summary import compress_text
    from flexgs_edge.run.options import METHOD_ONLY, CompressOptions, check_method

    # An option that is spelled out is meant, even where it says its default.
    source = click.get_current_context().get_parameter_source
    check_method(options["method"], [name for name in METHOD_ONLY if source(name) is ParameterSource.COMMANDLINE])
    result = compress(input, output, CompressOptions(**options), progress)
    talk.emit(compress_text(result), result.to_json(), json_path, options["force"])
