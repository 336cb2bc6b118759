"""`flexgs-edge evaluate`."""

from __future__ import annotations

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.option(
    "Quality",
    "--against",
    metavar="REF",
    required=True,
    help="The original: any scene, such as its .ply or model folder.",
)
@help_page.option(
    "Quality",
    "--lpips",
    is_flag=True,
    help="Also measure LPIPS (AlexNet), about 3 s a megapixel: needs flexgs-edge[lpips] and AlexNet's weights, 244 MB.",
)
@shared_options.base_psnr_option
@shared_options.report_option
@shared_options.photos_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
def command(
    input: str,
    against: str,
    lpips: bool,
    base_psnr: float,
    report: str | None,
    force: bool,
    json_path: str | None,
    quiet: bool,
    **options: Any,
) -> None:
    """Measure what a scene lost against another one, view by view, mean and worst.

    Fidelity is the PSNR (with SSIM, and LPIPS if asked for) between the two scenes' renders. With photos, drop is the PSNR
    against the photos that was lost on the way from REF to INPUT, in dB. Cameras and photos beside REF are used unless
    given, else those beside INPUT. The held-out views are measured; all views with --holdout 0.

    \b
    Examples:
      flexgs-edge evaluate scene.fgs --against point_cloud.ply
      flexgs-edge evaluate decoded.ply --against point_cloud.ply --cameras cameras.json --images photos
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --holdout 0 --json quality.json
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --report page
          figures and pictures in page/index.html
      flexgs-edge evaluate scene.fgs --against point_cloud.ply --lpips
    """
    progress = talk.start(quiet, json_path, force, report)
    from flexgs_edge.commands.evaluate import evaluate
    from flexgs_edge.report.summary import evaluate_text
    from flexgs_edge.run.options import ViewOptions

    result = evaluate(input, against, ViewOptions(**options), base_psnr, progress, report, force, lpips)
    talk.emit(evaluate_text(result), result.to_json(), json_path, force)
