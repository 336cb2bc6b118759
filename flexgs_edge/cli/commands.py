"""The subcommands but `compress` and `study`: each takes its arguments, and calls what does the work."""

from typing import Any

import click

from flexgs_edge.cli import help_page, shared_options, talk, value_types
from flexgs_edge.errors import DeviceError, FormatError
from flexgs_edge.progress import Progress
from flexgs_edge.report.run_info import Result


@click.command(cls=help_page.SectionCommand)
@click.argument("input", metavar="INPUT", type=click.Path())
@help_page.output_option(
    "-o",
    "--output",
    metavar="OUT",
    required=True,
    help="File to write: .ply, .spz, .sog, .compressed.ply, .splat, .glb, .usd, .usda, .usdc, .usdz, or FOLDER/lod-meta.json "
    "(streamed SOG).",
)
@shared_options.positions_options
@shared_options.writing_options
@help_page.output_option(
    "--double",
    is_flag=True,
    help="Write x y z of a .ply as doubles, which not every program reads. Default: the type that came in. A .fgs does not keep "
    "it: floats, unless they would ruin a scene far from zero.",
)
@help_page.views_option(
    "--cameras",
    metavar="PATH",
    help="Cameras of the pictures that show what another program's format loses. none: no pictures. Default: cameras beside "
    "the scene, else generated views (with --device numpy: none).",
)
@shared_options.reading_options
@help_page.device_option(
    "--device",
    metavar="SPEC",
    help="Device that draws the compared pictures; an OpenCL CPU also decodes a large .fgs of --method best. Its number, part "
    "of its name, or cpu. numpy: the same bits, slower. Default: as `devices` says, and a CPU for large files.",
)
@shared_options.memory_option
@shared_options.write_options
@talk.told
def decompress(
    input: str,
    output: str,
    recenter: bool,
    cameras: str | None,
    device: str | None,
    memory_limit: int | None,
    force: bool,
    frame: str | None,
    lod: int | None,
    sh_degree: int | None,
    crop: str | None,
    **writing: Any,
) -> Result:
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
    from flexgs_edge.commands.decompress import decompress
    from flexgs_edge.io.reading import Reading, Writing

    reading = Reading.of(frame, lod, sh_degree, crop)
    return decompress(
        input, output, force, memory_limit, device, reading, Writing(**writing), recenter=recenter, cameras=cameras
    )


@click.command(cls=help_page.SectionCommand)
@click.argument("file", metavar="FILE", type=click.Path())
@shared_options.crop_option
@shared_options.write_options
@talk.told
def info(file: str, crop: str | None) -> Result:
    """Show what a scene file holds.

    For a .fgs: Gaussians, SH degree, bits and bytes of every channel, layers, settings, and the target it reached. For other
    scene files and model folders: counts, and the cameras and photos beside them. To check every byte, use verify.

    \b
    Examples:
      flexgs-edge info scene.fgs
      flexgs-edge info scene.fgs --json - 2>/dev/null
    """
    from flexgs_edge.commands.info import info

    return info(file, crop)


@click.command(cls=help_page.SectionCommand)
@click.argument("input", metavar="IN.fgs", type=click.Path())
@help_page.output_option("-o", "--output", metavar="OUT.fgs", required=True, help="File to write.")
@help_page.output_option(
    "--max-size", type=value_types.SIZE, required=True, help="Largest size of the new file, such as 800kB or 1MiB."
)
@shared_options.write_options
@talk.told
def trim(input: str, output: str, max_size: int, force: bool) -> Result:
    """Cut a layered .fgs file to a size, without the original.

    compress --layers writes layers, from coarse to fine. trim keeps as many of the first layers as fit. The result is a valid
    scene, and info says what it was cut from. This takes as long as copying the file.

    \b
    Examples:
      flexgs-edge trim scene.fgs -o small.fgs --max-size 500kB
      flexgs-edge trim scene.fgs -o small.fgs --max-size 1MiB -f

    Where not even the first layer fits, the new file is the preview, if there is one.

    Exit code 3: nothing fits.
    """
    from flexgs_edge.commands.trim import trim

    return trim(input, output, max_size, force)


@click.command(cls=help_page.SectionCommand)
@click.argument("file", metavar="FILE.fgs", type=click.Path())
@shared_options.write_options
def verify(file: str, force: bool, json_path: str | None, quiet: bool) -> None:
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


@click.command(cls=help_page.SectionCommand)
@help_page.device_option(
    "--device", metavar="SPEC", help="Say which device this would choose: a number, part of a name, cpu or gpu."
)
@help_page.device_option(
    "--self-test", "self_test", is_flag=True, help="Test every device anew, also those with a verdict."
)
@shared_options.write_options
def devices(device: str | None, self_test: bool, force: bool, json_path: str | None, quiet: bool) -> None:
    """List the OpenCL devices, and say which one is used.

    Shows the limits of every device, and whether it passes the self-test: it runs all kernels on small scenes, and every
    result must have the right bits. The verdict is kept until the driver or the kernels change.

    \b
    Examples:
      flexgs-edge devices
      flexgs-edge devices --device gpu
      flexgs-edge devices --json - 2>/dev/null

    Exit code 4: no device works, or not the one asked for. The message says what to install.
    """
    talk.start(quiet, json_path, force)
    from flexgs_edge.commands.devices import devices

    result = devices(device, self_test)
    talk.emit(result.summary(), result.to_json(), json_path, force)
    if result.chosen is None:
        raise DeviceError(result.reason)


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.output_option(
    "-o",
    "--output",
    metavar="PAGE.html|FOLDER",
    help="Write one file that opens from disk, without a network, or the folder of a web site. "
    "Default: serve the scene until Ctrl-C.",
)
@help_page.output_option("--browser/--no-browser", default=True, help="Open the page in the browser. Default: open it.")
@help_page.output_option(
    "--port", metavar="N", type=int, default=0, show_default="any free", help="Port of the server."
)
@help_page.output_option(
    "--host",
    metavar="ADDRESS",
    default="127.0.0.1",
    help="Address of the server. Others than the default let other machines see the scene.",
)
@help_page.output_option(
    "--notes",
    metavar="FILE.json",
    help='Show texts at places of the scene: a list of {"at": [x, y, z], "text": "..."}.',
)
@shared_options.cameras_option
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.memory_option
@shared_options.write_options
@talk.told
def view(
    input: str,
    output: str | None,
    browser: bool,
    port: int,
    host: str,
    notes: str | None,
    force: bool,
    quiet: bool,
    progress: Progress,
    **options: Any,
) -> Result:
    """Look at a scene in the browser.

    The page draws the scene as render does, and lets you turn and fly through it. Cameras are a list to choose from. Nothing is
    loaded from elsewhere. With -o PAGE.html, viewer and scene become one file to mail or to keep; compress a scene first, since
    the page holds all of its bytes. With -o FOLDER, they become a web site: page, scene, a picture to show until it is there, and
    the lines that put it into another page.

    \b
    Examples:
      flexgs-edge view scene.fgs
      flexgs-edge view scene.fgs --cameras cameras.json -o scene.html
      flexgs-edge view scene.fgs -o site/
      flexgs-edge view point_cloud.ply --no-browser --port 8000
    """
    from flexgs_edge.commands.view import view
    from flexgs_edge.run.options import ViewOptions

    drawing = ViewOptions(**options)
    return view(input, output, drawing, force, progress, host, port, browser, notes, _say(quiet))


def _say(quiet: bool) -> Any:
    """Print the address also when the log is off: without it, nobody finds the page."""

    def say(server: Any) -> None:
        if quiet:
            from flexgs_edge.viewer.assets import PAGE

            click.echo(server.address(PAGE), err=True)

    return say


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.output_option(
    "-o", "--output", metavar="DIR", required=True, help="Folder for the PNG files; made if missing."
)
@shared_options.cameras_option
@help_page.views_option(
    "--views",
    type=value_types.VIEWS,
    help="Views to draw, counted from 0 in order of name: a list such as 0,8,16, or START:STOP:STEP such as 0:50:8. "
    "Default: all.",
)
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
@talk.told
def render(input: str, output: str, views: list[int] | None, force: bool, progress: Progress, **options: Any) -> Result:
    """Draw views of a scene as PNG files.

    The files are named after the cameras. A .fgs says how it is drawn: near plane, background and antialiasing.
    Options override that. The summary shows the median time of a view, without start-up and without writing files.

    \b
    Examples:
      flexgs-edge render scene.fgs -o views --cameras cameras.json
      flexgs-edge render point_cloud.ply -o views --views 0:50:8 --background white
      flexgs-edge render scene.fgs -o views --cameras cameras.json --views 0 --json - 2>/dev/null
    """
    from flexgs_edge.commands.render import render_views
    from flexgs_edge.run.options import ViewOptions

    return render_views(input, output, ViewOptions(**options), views, force, progress)


@click.command(cls=help_page.SectionCommand)
@shared_options.scene_argument
@help_page.output_option("-o", "--output", metavar="SHEET.png", required=True, help="The PNG file.")
@shared_options.cameras_option
@shared_options.reading_options
@shared_options.drawing_options
@shared_options.drop_invalid_option
@shared_options.run_options
@talk.told
def views(input: str, output: str, force: bool, progress: Progress, **options: Any) -> Result:
    """Draw all views of a scene on one sheet.

    It shows at a glance where views stand, above all those that are placed automatically for a scene without cameras. Views with
    a star are held out: they decide.

    \b
    Examples:
      flexgs-edge views point_cloud.ply -o sheet.png
      flexgs-edge views point_cloud.ply -o sheet.png --cameras auto
    """
    from flexgs_edge.commands.render import draw_sheet
    from flexgs_edge.run.options import ViewOptions

    return draw_sheet(input, output, ViewOptions(**options), force, progress)


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
@talk.told
def evaluate(
    input: str,
    against: str,
    lpips: bool,
    base_psnr: float | None,
    report: str | None,
    force: bool,
    progress: Progress,
    **options: Any,
) -> Result:
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
    from flexgs_edge.commands.evaluate import evaluate
    from flexgs_edge.run.options import ViewOptions

    return evaluate(input, against, ViewOptions(**options), base_psnr, progress, report, force, lpips)
