"""`flexgs-edge compress`."""

from __future__ import annotations

from typing import Any

import click
from click.core import ParameterSource

from flexgs_edge.cli import shared_options, talk, value_types
from flexgs_edge.cli.help_page import EFFORT, MACHINES, METHOD, OUTPUT, VIEWS, ExpertCommand, option

REACH = "What to reach (give one target; default: --max-drop 1.0)"
USUAL = (
    "max_drop",
    "min_fidelity",
    "max_worst_drop",
    "max_size",
    "min_ratio",
    "best_effort",
    "cameras",
    "images",
    "antialiased",
    "views_margin",
    "effort",
    "memory_limit",
    "device",
    "output",
    "layers",
    "report",
    "json_path",
    "dry_run",
    "force",
    "quiet",
)
"""Options that `--help` shows, in order. `--expert` shows the others too."""
MORE = """\b
More examples:
  flexgs-edge compress point_cloud.ply -o a.fgs --method paper --score-cache s.npz
  flexgs-edge compress point_cloud.ply -o b.fgs --method paper --score-cache s.npz --max-drop 2
      the paper's method, for two targets; the second run reuses the scores
  flexgs-edge compress point_cloud.ply -o c.fgs --method paper --prune-rate 0.3 --sh-rate 0.4
      fixed rates, no search
  flexgs-edge compress point_cloud.ply -o d.fgs --cluster local:2
      draws views in two processes
  flexgs-edge compress big.ply -o big.fgs --memory-limit 1GiB --scratch /data/tmp --resume
      for a scene larger than memory; goes on after an interruption
"""


@click.command(cls=ExpertCommand, usual=USUAL, more=MORE)
@shared_options.scene_argument
@option(
    REACH,
    "--max-drop",
    metavar="DB",
    type=float,
    help="Smallest file that loses at most DB of PSNR against the photos. Without photos the loss is estimated.",
)
@option(
    REACH,
    "--min-fidelity",
    metavar="DB",
    type=float,
    help="Smallest file with this PSNR to the original's renders.",
)
@option(
    REACH,
    "--max-worst-drop",
    metavar="DB",
    type=float,
    help="With one of the two above: no view may lose more.",
)
@option(REACH, "--max-size", type=value_types.SIZE, help="Best quality in at most this size, such as 8MB or 8MiB.")
@option(REACH, "--min-ratio", metavar="R", type=float, help="Best quality in a file R times smaller than the .ply.")
@option(REACH, "--best-effort", is_flag=True, help="If the target cannot be met, write the closest result.")
@shared_options.photos_options
@option(
    VIEWS,
    "--views-margin",
    is_flag=True,
    help="Also use generated camera views: closer, farther and in between. For scenes that people walk through. "
    "Slower, slightly larger files.",
)
@shared_options.select_option
@shared_options.drawing_options
@shared_options.base_psnr_option
@shared_options.drop_invalid_option
@option(
    EFFORT,
    "--effort",
    metavar="WORD",
    type=click.Choice(["fast", "balanced", "thorough", "max"]),
    default="balanced",
    show_default=True,
    help="fast, balanced, thorough or max (.fgs only). More effort: smaller files, slower.",
)
@option(
    MACHINES,
    "--scratch",
    metavar="DIR",
    help="Folder for scratch files, written if a scene does not fit into the memory limit. Default: beside OUT.",
)
@option(
    MACHINES,
    "--resume",
    is_flag=True,
    help="Save the progress in the scratch folder. After an interruption, the same command goes on from there. "
    "The bytes stay the same.",
)
@option(
    MACHINES,
    "--cluster",
    metavar="ADDRESS|local:N",
    help="Draw views in N processes here (local:N) or on a Dask cluster, such as tcp://HOST:8786. Needs "
    "pip install 'flexgs-edge[cluster]'. The bytes stay the same.",
)
@option(OUTPUT, "-o", "--output", metavar="OUT", help="File to write: .fgs, .spz, .sog or .compressed.ply.")
@option(
    OUTPUT,
    "--layers",
    metavar="N",
    type=int,
    default=1,
    show_default=True,
    help="Layers, up to 4, that `flexgs-edge trim` can cut. More: slightly larger file.",
)
@shared_options.report_option
@option(OUTPUT, "--dry-run", is_flag=True, help="Write nothing (no -o needed). The size shown is exact.")
@option(
    METHOD,
    "--method",
    type=click.Choice(["best", "paper"]),
    default="best",
    show_default=True,
    help="best: the smallest files. paper: the FlexGaussian paper's method; faster, much larger files.",
)
@option(
    METHOD,
    "--unseen",
    metavar="keep|drop|N%",
    default="keep",
    show_default=True,
    help="What to do with Gaussians that no training view sees. keep: without view-dependent colour. drop: leave them out. "
    "N%: only the largest and most opaque N %.",
)
@option(
    METHOD,
    "--refit/--no-refit",
    default=True,
    help="Adjust colours to what was removed and rounded. Off: faster, larger files. Default: on.",
)
@option(
    METHOD,
    "--distil",
    metavar="STEPS",
    type=int,
    help="Fine-tune all remaining Gaussians against renders of the original, one view a step. Needs no photos; .fgs only. "
    "Slower, smaller files. 0: off. Default: off; with --effort max, 10 steps a scored view.",
)
@option(
    METHOD,
    "--score",
    metavar="gs|meson|FILE",
    default="gs",
    show_default=True,
    help="Importance of a Gaussian. gs: opacity, volume and pixels hit. meson: as MesonGS. FILE: .npy or .npz, one number "
    "a Gaussian.",
)
@option(METHOD, "--save-scores", metavar="FILE", help="Write the scores to a .npy file, for --score in later runs.")
@option(
    METHOD,
    "--score-cache",
    metavar="FILE",
    help="Keep the scores in FILE. Later runs with the same scene, views and --score reuse them.",
)
@option(
    METHOD,
    "--prune-rate",
    metavar="P",
    type=float,
    help="Remove this share of the Gaussians, from 0 to 1, without a search. Needs --sh-rate.",
)
@option(
    METHOD,
    "--sh-rate",
    metavar="S",
    type=float,
    help="Remove the view-dependent colour of a further share of the Gaussians, from 0 to 1. Needs --prune-rate.",
)
@option(
    METHOD,
    "--bits",
    metavar="SPEC",
    default="paper",
    show_default=True,
    help="Bits of each value. paper: xyz=16,dc=8,scale=8,rot=8,opacity=4,rest=4. A list such as rest=3,dc=7: the others as in "
    "paper. auto: searched. rtn8, rtn4, ...: as many for all values (a weak baseline).",
)
@option(
    METHOD,
    "--groups",
    metavar="N",
    type=int,
    help="Ranges of each channel. More: better, larger files. Default: one for about 512 Gaussians.",
)
@shared_options.run_options
def command(input: str, output: str | None, json_path: str | None, quiet: bool, **options: Any) -> None:
    """Make a scene smaller: to a quality or to a size.

    INPUT is a .ply, .fgs, .spz, .sog or .compressed.ply file, or the folder that 3DGS training writes. Cameras and photos
    beside it are used.

    \b
    Examples:
      flexgs-edge compress point_cloud.ply -o scene.fgs
      flexgs-edge compress output/garden -o garden.fgs --images data/garden/images_4
      flexgs-edge compress point_cloud.ply -o scene.fgs --max-size 8MB
      flexgs-edge compress point_cloud.ply -o scene.fgs --effort fast  # faster, larger
      flexgs-edge compress point_cloud.ply -o scene.spz  # needs flexgs-edge[formats]
    Measured times and sizes: docs/results/speed.md
    Exit code 3: the target cannot be met; the message names the closest result.
    """
    progress = talk.start(quiet, json_path, options["force"], options["report"])
    from flexgs_edge.commands.compress import compress
    from flexgs_edge.run.options import METHOD_ONLY, CompressOptions, check_method

    # An option that the user typed counts as given, even if it equals the default.
    source = click.get_current_context().get_parameter_source
    check_method(options["method"], [name for name in METHOD_ONLY if source(name) is ParameterSource.COMMANDLINE])
    result = compress(input, output, CompressOptions(**options), progress)
    talk.emit(result.summary(), result.to_json(), json_path, options["force"])
