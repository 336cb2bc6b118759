"""Options that several subcommands share."""

import click

from flexgs_edge.cli.help_page import DEVICE, FAULTS, input_option, option, output_option, stack, views_option
from flexgs_edge.cli.talk import set_debug
from flexgs_edge.cli.value_types import AXIS, COLOUR, SIZE
from flexgs_edge.constants import DEFAULT_HOLDOUT, DEFAULT_NEAR, MAX_VIEW_WIDTH

scene_argument = click.argument("input", metavar="INPUT", type=click.Path())
crop_option = input_option(
    "--crop",
    metavar="BOX",
    help="Keep only Gaussians inside: x,y,z,X,Y,Z (two corners), x,y,z,R (a sphere), or a JSON file with a turned box "
    "(docs/formats.md). World coordinates of the .ply that decompress writes. Photos are not compared then.",
)
reading_options = stack(
    input_option(
        "--frame",
        metavar="XYZ",
        help="Where the axes of the file point, if it breaks the rule of its format: R or L, U or D, F or B, such as RUB. "
        "Default: as the file or its format says (docs/formats.md).",
    ),
    input_option(
        "--lod",
        metavar="N",
        type=int,
        help="Level of a streamed scene (lod-meta.json), 0 is the finest. Default: the finest that is there.",
    ),
    input_option(
        "--sh-degree",
        metavar="N",
        type=int,
        help="Leave out view-dependent colour (SH) above degree N. Default: keep all.",
    ),
    crop_option,
)  # Options of every command that reads a scene with its values
writing_options = stack(
    output_option(
        "--spz-version", metavar="3|4", type=int, default=3, help="Version of a .spz. Older programs read only 3."
    ),
    output_option(
        "--glb",
        metavar="plain|spz",
        default="plain",
        help="What holds the values of a .glb. spz: much smaller, by a draft of an extension that CesiumJS reads.",
    ),
)
positions_options = stack(
    output_option(
        "--recenter",
        is_flag=True,
        help="Other programs' formats: move a scene far from zero to zero, and write the offset beside the file "
        "(OUT.offset.json).",
    ),
    output_option(
        "--force-lossy",
        is_flag=True,
        help="Other programs' formats: write positions that the format cannot hold, rounded. Default: refuse.",
    ),
)
cameras_option = stack(
    views_option(
        "--cameras",
        metavar="PATH",
        help="cameras.json, transforms.json, a COLMAP model, or a folder with one. auto: generated views. none: no views. "
        "Default: cameras beside the scene, else auto.",
    ),
    views_option(
        "--ignore-distortion",
        is_flag=True,
        help="Use cameras with lens distortion as if they had none. Their photos are not compared. Default: undistort photos.",
    ),
    views_option(
        "--dataparser",
        metavar="FILE",
        help="dataparser_transforms.json of nerfstudio's training, for a transforms.json. Default: the one near the scene, "
        "the cameras, or in outputs/.",
    ),
    views_option(
        "--up",
        type=AXIS,
        help="Up of automatic views: x, -x, y, -y, z, -z, or three numbers such as 0,-1,0.2. It is a direction in the frame "
        "of the .ply that decompress writes. Default: what the scene shows, else -y.",
    ),
)
images_option = views_option(
    "--images",
    metavar="DIR",
    help="Photos (JPEG, PNG, WebP, TIFF), named after the cameras. none: no photos. Default: images/ beside the scene.",
)
exposure_option = views_option(
    "--exposure",
    type=click.Choice(["fit", "none"]),
    default="fit",
    help="fit: bring photos of another exposure or white balance than the scene's to the scene's before they are compared. "
    "none: compare them as they are.",
)
holdout_option = views_option(
    "--holdout",
    metavar="N",
    type=int,
    default=DEFAULT_HOLDOUT,
    help="Hold out every N-th view by name, from the first. Held-out views measure quality, the others are training views. "
    "0: hold out none.",
)
select_option = views_option(
    "--select",
    type=click.Choice(["test", "train"]),
    default="test",
    help="Views that decide if the target is met: held-out ones (test) or training views (train). Training views are not "
    "compared with photos.",
)
drawing_options = stack(
    views_option(
        "--resolution",
        metavar="PIXELS",
        type=int,
        default=MAX_VIEW_WIDTH,
        help="Largest width of a view. Wider views are scaled down. Smaller is faster and less exact.",
    ),
    views_option(
        "--near",
        metavar="Z",
        type=float,
        help=f"Near plane: Gaussians closer than Z scene units are not drawn. Default: the file's, else {DEFAULT_NEAR}, "
        "or less for automatic views of small scenes.",
    ),
    views_option(
        "--background",
        type=COLOUR,
        help="black, white, #rrggbb, or red,green,blue from 0 to 1. Default: as the file or cfg_args says, else black.",
    ),
    views_option(
        "--antialiased/--no-antialiased",
        default=None,
        help="For models trained with antialiasing. Default: as the file or cfg_args says, else off.",
    ),
)
base_psnr_option = views_option(
    "--base-psnr",
    metavar="DB",
    type=float,
    help="The modelled drop (the estimate without photos) assumes this PSNR of the original against its photos. "
    "Higher is more cautious. Default: PSNR of its views against themselves, moved by three quarters of a pixel (32.5 to 36).",
)
drop_invalid_option = views_option(
    "--drop-invalid",
    is_flag=True,
    help="Leave out Gaussians with NaN, infinity or a zero rotation. Default: refuse the scene.",
)
device_option = option(
    DEVICE,
    "--device",
    metavar="SPEC",
    help="OpenCL device: number, name, cpu or gpu; or numpy (far slower). Default: the first GPU that works, else a CPU.",
)
memory_option = option(
    DEVICE,
    "--memory-limit",
    type=SIZE,
    help="Most memory for the run, such as 600MiB or 2GB. Less is slower. Default: 3/4 of the free memory.",
)
force_option = output_option("-f", "--force", is_flag=True, help="Overwrite files that exist.")
report_option = output_option("--report", metavar="DIR", help="Write a page about the result: DIR/index.html.")
json_option = output_option(
    "--json", "json_path", metavar="FILE", help="Write the result as JSON to FILE; - is stdout."
)
quiet_option = output_option("-q", "--quiet", is_flag=True, help="Show no log and no progress bars.")
debug_option = option(
    FAULTS,
    "--debug",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=set_debug,
    help="Show tracebacks of errors.",
)
write_options = stack(json_option, force_option, quiet_option, debug_option)  # Options of every command
run_options = stack(memory_option, device_option, write_options)
"""Options of every command that uses a device and writes a file."""
photos_options = stack(cameras_option, images_option, holdout_option)  # Options for cameras, photos and held-out views
study_options = stack(
    reading_options,
    photos_options,
    exposure_option,
    select_option,
    drawing_options,
    base_psnr_option,
    drop_invalid_option,
    run_options,
)  # Options of every study
results_option = output_option(
    "-o", "--output", metavar="DIR", required=True, help="Folder for the results; made if missing."
)  # Options for the output of a study
study_target_option = option(
    "Target", "--max-drop", metavar="DB", type=float, default=1.0, help="Loss of PSNR that compressed results aim at."
)
