"""`flexgs-edge evaluate`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(
    "Quality", "--against", metavar="REF", required=True, help="The original (REF): any scene file or model folder."
)
@help_page.option(
    "Quality",
    "--lpips",
    is_flag=True,
    help="Also measure LPIPS (AlexNet). Slow. Needs pip install 'flexgs-edge[lpips]' and AlexNet's weights.",
)
@shared_options.report_option
@shared_options.photos_options
@shared_options.exposure_option
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.base_psnr_option
@shared_options.drop_invalid_option
@shared_options.run_options
def command(
    input: str,
    against: str,
    lpips: bool,
    base_psnr: float | None,
    report: str | None,
    force: bool,
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Compare a scene with its original, view by view.

    Fidelity is the PSNR between the renders of INPUT and those of REF, in dB. SSIM and FLIP are measured too. Drop is the PSNR
    that was lost against the photos, in dB; without photos it is estimated. The summary shows the mean and the worst view.

    Only held-out views are measured; --holdout 0 measures all. Cameras and photos are those beside REF, else those beside
    INPUT.

    \b
    Examples:
      flexgs-edge evaluate scene.fgs --against point_cloud.ply
      flexgs-edge evaluate decoded.ply --against point_cloud.ply --cameras cameras.json --images photos
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --holdout 0 --json quality.json
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --report page
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --lpips
    """
    progress = talk.start(quiet, json_path, force, report)
    from flexgs_edge.commands.evaluate import evaluate
    from flexgs_edge.run.options import ViewOptions

    result = evaluate(input, against, ViewOptions(**options), base_psnr, progress, report, force, lpips)
    talk.emit(result.summary(), result.to_json(), json_path, force)
