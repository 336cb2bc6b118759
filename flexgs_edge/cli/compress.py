"""`flexgs-edge compress`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click
from click.core import ParameterSource

from flexgs_edge.cli import shared_options, talk, value_types
from flexgs_edge.cli.help_page import EFFORT, INPUT, MACHINES, METHOD, OUTPUT, VIEWS, ExpertCommand, option

if TYPE_CHECKING:
    from flexgs_edge.progress import Progress
    from flexgs_edge.report.results import BatchResult
    from flexgs_edge.run.options import CompressOptions

REACH = "What to reach (give one target; default: --max-drop 1.0)"
USUAL = (
    "max_drop", "min_fidelity", "max_worst_drop", "max_size", "min_ratio", "best_effort", "cameras", "images",
    "antialiased", "effort", "memory_limit", "device", "output", "layers", "preview", "report", "json_path", "dry_run",
    "force", "quiet",
)  # fmt: skip
"""Options that `--help` shows, in order. `--expert` shows the others too."""
MORE = """\b
More examples:
  flexgs-edge compress point_cloud.ply -o a.fgs --method paper --score-cache s.npz
  flexgs-edge compress point_cloud.ply -o b.fgs --method paper --score-cache s.npz --max-drop 2
      the paper's method, for two targets; the second run reuses the scores
  flexgs-edge compress point_cloud.ply -o c.fgs --method paper --prune-rate 0.3 --sh-rate 0.4
      fixed rates, no search
  flexgs-edge compress big.ply -o big.fgs --memory-limit 1GiB --scratch /data/tmp --resume
      for a scene larger than memory; goes on after an interruption
  flexgs-edge compress scans/ garden/ -o small/ --format .spz
      every scene that lies in scans, and the model folder garden

\b
Several scenes:
  A folder stands for the scenes directly in it: files, model folders, SOG folders.
  A folder with a point_cloud.ply, and no other scene but .fgs, is one scene.
  Targets hold for each scene. A scene that fails does not stop the others.
  a.ply becomes OUT/a.fgs. Scenes of the same name keep their suffix (a.ply.fgs,
  a.spz.fgs), then get their folders' names in front (x-a.ply.fgs, y-a.ply.fgs).
  --json writes one list. Exit code 2: a scene failed. 1: by a fault of ours.
"""


@click.command(cls=ExpertCommand, usual=USUAL, more=MORE)
@click.argument("inputs", metavar="INPUT...", type=click.Path(), nargs=-1, required=True)
@option(
    REACH,
    "--max-drop",
    metavar="DB",
    type=float,
    help="Smallest file that loses at most DB of PSNR against the photos. Without photos the loss is estimated.",
)
@option(
    REACH, "--min-fidelity", metavar="DB", type=float, help="Smallest file with this PSNR to the original's renders."
)
@option(
    REACH,
    "--max-worst-drop",
    metavar="DB",
    type=value_types.BOUND,
    help="No view may lose more. Default: as the target allows.",
)
@option(
    REACH,
    "--max-ssim-drop",
    metavar="X",
    type=value_types.BOUND,
    help="Most SSIM lost in the mean; none: no bound. Default: in proportion to the target.",
)
@option(
    REACH,
    "--promise",
    type=click.Choice(["whole", "mean"]),
    default="whole",
    help="whole: also bound the worst view, SSIM and made poses. mean: the target alone, by the mean of the views.",
)
@option(REACH, "--max-size", type=value_types.SIZE, help="Best quality in at most this size, such as 8MB or 8MiB.")
@option(REACH, "--min-ratio", metavar="R", type=float, help="Best quality in 1/R of the scene's bytes as a .ply.")
@option(REACH, "--max-gaussians", metavar="N", type=int, help="Keep at most N Gaussians, whatever the target allows.")
@option(REACH, "--best-effort", is_flag=True, help="Write the closest result to a target, however large.")
@shared_options.reading_options
@shared_options.photos_options
@shared_options.exposure_option
@option(
    VIEWS,
    "--views-margin/--no-views-margin",
    default=None,
    help="Also use made camera views: closer, farther and in between, and bound what they lose. Default: as --promise says.",
)
@shared_options.select_option
@shared_options.drawing_options
@shared_options.base_psnr_option
@option(
    VIEWS,
    "--trust-views",
    is_flag=True,
    help="Go on where the photos do not show what the scene shows from their cameras. Default: stop, and name the likely cause.",
)
@shared_options.drop_invalid_option
@option(
    INPUT,
    "--clean",
    metavar="[gentle|thorough]",
    is_flag=False,
    flag_value="gentle",
    help="Leave out floaters, needles and invalid values, and isolated matter that no view shows (gentle; the word may be left "
    "out) or hardly shows (thorough).",
)
@option(
    OUTPUT, "--keep-removed", metavar="FILE", help="Write what --clean removed, with the values that came in: a .ply."
)
@option(
    EFFORT,
    "--effort",
    metavar="WORD",
    type=click.Choice(["fast", "balanced", "max"]),
    default="balanced",
    help="fast or balanced: smaller files, slower. max is another word for balanced.",
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
@option(OUTPUT, "-o", "--output", metavar="OUT", help="File (.fgs, others: docs/formats.md), or a folder OUT/.")
@option(OUTPUT, "--format", metavar="SUFFIX", help="Format of the files in a folder OUT/, such as .spz. Default: .fgs.")
@shared_options.writing_options
@shared_options.positions_options
@option(
    OUTPUT,
    "--layers",
    metavar="N",
    type=int,
    default=None,
    help="Layers, up to 4, that `trim` can cut and viewers show one by one.",
)
@option(
    OUTPUT,
    "--preview",
    type=value_types.SIZE,
    help="Most bytes of a small scene that viewers show at once; 0: none. Default: 2 % of a file of "
    "1 MB or more, if at most 262144 Gaussians or three fifths of the scene are left.",
)
@shared_options.report_option
@option(OUTPUT, "--dry-run", is_flag=True, help="Write nothing (no -o needed). The size shown is exact.")
@option(
    METHOD,
    "--method",
    type=click.Choice(["best", "paper"]),
    default="best",
    help="best: the smallest files. paper: the FlexGaussian paper's method; faster, much larger files.",
)
@option(
    METHOD,
    "--unseen",
    metavar="keep|drop|N%",
    default="keep",
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
    "--finetune",
    "--distil",
    "distil",
    metavar="STEPS",
    type=int,
    help="Fine-tune all remaining Gaussians against renders of the original, one view a step. Needs no photos; .fgs only. "
    "Slower, smaller files. 0: off. Default: by --effort.",
)
@option(
    METHOD,
    "--score",
    type=click.Choice(["gs", "meson"]),
    default="gs",
    help="Importance of a Gaussian. gs: opacity, volume and pixels hit. meson: as MesonGS.",
)
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
    help="Bits of each value. paper: xyz=16,dc=8,scale=8,rot=8,opacity=4,rest=4. A list such as rest=3,dc=7: the others as in "
    "paper. rtn8, rtn4, ...: as many for all values (a weak baseline).",
)
@option(
    METHOD,
    "--groups",
    metavar="N",
    type=int,
    help="Ranges of each channel. More: better, larger files. Default: one for about 512 Gaussians.",
)
@shared_options.run_options
def compress(
    inputs: tuple[str, ...], output: str | None, format: str | None, json_path: str | None, quiet: bool, **options: Any
) -> None:
    """Make a scene smaller: to a quality or to a size.

    INPUT is a .ply, .fgs, .spz, .sog or .compressed.ply file, or the folder that 3DGS training writes. Cameras and photos
    beside it are used. Several scenes, or a folder of them, are written to a folder OUT/.

    \b
    Examples:
      flexgs-edge compress point_cloud.ply -o scene.fgs
      flexgs-edge compress output/garden -o garden.fgs --images data/garden/images_4
      flexgs-edge compress point_cloud.ply -o scene.fgs --max-size 8MB
      flexgs-edge compress a.ply b.ply scans/ -o small/ --effort fast  # faster, larger
    Measured times and sizes: docs/results/speed.md
    Exit code 3: the target cannot be met; the message names the closest result.
    """
    progress = talk.start(quiet, json_path, options["force"], options["report"])
    from flexgs_edge.commands.compress import compress
    from flexgs_edge.commands.compress_all import is_batch, single_output
    from flexgs_edge.run.options import METHOD_ONLY, CompressOptions, check_method

    # An option that the user typed counts as given, even if it equals the default.
    source = click.get_current_context().get_parameter_source
    check_method(options["method"], [name for name in METHOD_ONLY if source(name) is ParameterSource.COMMANDLINE])
    settings = CompressOptions(**options)
    if is_batch(inputs, output):
        _compress_all(inputs, output, settings, format, progress, json_path)
        return
    result = compress(inputs[0], single_output(output, format, settings.dry_run), settings, progress)
    talk.emit(result.summary(), result.to_json(), json_path, settings.force)


def _compress_all(
    inputs: tuple[str, ...],
    output: str | None,
    settings: CompressOptions,
    format: str | None,
    progress: Progress,
    json_path: str | None,
) -> None:
    """Compress several scenes. What is done is told even if the run is interrupted."""
    from flexgs_edge.commands.compress_all import compress_all

    so_far: list[BatchResult] = []
    try:
        result = compress_all(inputs, output, settings, progress, format, so_far.append)
    except (KeyboardInterrupt, SystemExit):
        for last in so_far[-1:]:
            talk.emit(last.summary(), last.to_json(), json_path, settings.force)
        raise
    talk.emit(result.summary(), result.to_json(), json_path, settings.force)
    click.get_current_context().exit(result.exit_code)
