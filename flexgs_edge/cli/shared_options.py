"""Options that several subcommands share."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import click

from flexgs_edge.cli.talk import set_debug
from flexgs_edge.cli.value_types import COLOUR, SIZE
from flexgs_edge.constants import DEFAULT_BASE_PSNR, DEFAULT_HOLDOUT, DEFAULT_NEAR, MAX_VIEW_WIDTH

Decorated = TypeVar("Decorated", bound=Callable[..., Any])
LAST = "Run"
"""The section of what every command has: shown after what is its own."""


class SectionOption(click.Option):
    """An option that appears under a heading of its own in `--help`."""

    def __init__(self, *args: Any, section: str = "Options", **kwargs: Any) -> None:
        self.section = section
        super().__init__(*args, **kwargs)


class SectionCommand(click.Command):
    """A command whose `--help` groups options by `SectionOption.section`."""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        sections: dict[str, list[tuple[str, str]]] = {}
        for parameter in self.get_params(ctx):
            record = parameter.get_help_record(ctx) if isinstance(parameter, click.Option) else None
            if record is not None:
                sections.setdefault(getattr(parameter, "section", LAST), []).append(record)
        for name in sorted(sections, key=lambda name: name == LAST):
            with formatter.section(name):
                formatter.write_dl(sections[name])


def option(section: str, *names: str, **kwargs: Any) -> Callable[[Decorated], Decorated]:
    """A `click.option` under a heading."""
    return click.option(*names, cls=SectionOption, section=section, **kwargs)


def stack(*decorators: Callable[[Any], Any]) -> Callable[[Decorated], Decorated]:
    """Several decorators as one, in the order in which `--help` shall show them."""

    def apply(function: Decorated) -> Decorated:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


scene_argument = click.argument("input", metavar="INPUT", type=click.Path())
cameras_option = stack(
    option(
        "Views",
        "--cameras",
        metavar="PATH",
        help="Camera poses: INRIA's cameras.json, a COLMAP model's folder, a transforms.json, or a folder with one of them; "
        "auto makes views from the scene itself, none uses none. Default: what lies beside the scene, else auto.",
    ),
    option(
        "Views",
        "--ignore-distortion",
        is_flag=True,
        help="Take the poses of distorted lenses as if they had none; photos of such lenses are not compared.",
    ),
)
images_option = option(
    "Views",
    "--images",
    metavar="DIR",
    help="Folder of photos named after the cameras; `none` leaves photos alone. Default: images/ beside the scene.",
)
holdout_option = option(
    "Views",
    "--holdout",
    metavar="N",
    type=int,
    default=DEFAULT_HOLDOUT,
    show_default=True,
    help="Every N-th view by name is held out (the first, the N+1st, ...); 0 holds out none.",
)
select_option = option(
    "Views",
    "--select",
    type=click.Choice(["test", "train"]),
    default="test",
    show_default=True,
    help="Views that decide where to stop: the held-out ones, or the training poses (then fidelity and modelled drop decide).",
)
drawing_options = stack(
    option(
        "Views",
        "--resolution",
        metavar="PIXELS",
        type=int,
        default=MAX_VIEW_WIDTH,
        show_default=True,
        help="Wider views are scaled down to this width; smaller is faster and less exact.",
    ),
    option(
        "Views",
        "--near",
        metavar="Z",
        type=float,
        help=f"Near plane in scene units: closer Gaussians are not drawn. Default: the file's, else {DEFAULT_NEAR}.",
    ),
    option(
        "Views",
        "--background",
        type=COLOUR,
        help="black, white, #rrggbb, or red,green,blue from 0 to 1. Default: the file's (or cfg_args'), else black.",
    ),
    option(
        "Views",
        "--extent",
        type=click.Choice(["exact", "inria"]),
        help="Reach of a splat: the exact ellipse of alpha >= 1/255, or INRIA's 3 sigma in whole tiles. Default: exact.",
    ),
    option(
        "Views",
        "--antialiased/--no-antialiased",
        default=None,
        help="Compensate opacities for the dilation, for models trained so (INRIA's --antialiasing, gsplat's antialiased, "
        "Mip-Splatting). Default: the file's (or cfg_args'), else not.",
    ),
)
base_psnr_option = option(
    "Quality",
    "--base-psnr",
    metavar="DB",
    type=float,
    default=DEFAULT_BASE_PSNR,
    show_default=True,
    help="PSNR of the original against its photos that the modelled drop starts from, in dB: cautious where unknown.",
)
drop_invalid_option = option(
    "Run",
    "--drop-invalid",
    is_flag=True,
    help="Leave Gaussians with NaN, infinity or zero rotations out instead of refusing.",
)
device_option = option(
    "Run",
    "--device",
    metavar="SPEC",
    help="OpenCL device: its number, part of its name, cpu or gpu (see `flexgs-edge devices`); numpy runs the NumPy twins: "
    "the same results, far slower. Default: the first GPU that works, else a CPU.",
)
memory_option = option(
    "Run",
    "--memory-limit",
    type=SIZE,
    help="Most memory for the whole run, such as 600MiB or 2GB; work is cut into parts that fit. Default: 3/4 of what is free.",
)
force_option = option("Run", "-f", "--force", is_flag=True, help="Overwrite files that exist.")
report_option = option(
    "Output",
    "--report",
    metavar="DIR",
    help="Write a page to DIR/index.html: figures, the search, bytes, views with original and result under a slider, cameras; "
    "and the record to DIR/result.json.",
)
json_option = option(
    "Run",
    "--json",
    "json_path",
    metavar="FILE",
    help="Write the result as JSON to FILE; - writes it to stdout and moves the summary to stderr.",
)
talk_options = stack(
    option("Run", "-q", "--quiet", is_flag=True, help="No log and no progress bars; the summary stays."),
    option(
        "Run",
        "--debug",
        is_flag=True,
        is_eager=True,
        expose_value=False,
        callback=set_debug,
        help="Show tracebacks of errors.",
    ),
)

run_options = stack(device_option, memory_option, force_option, json_option, talk_options)
"""What every command has that works on a device and writes something."""
photos_options = stack(cameras_option, images_option, holdout_option)
"""Where the views are, and which of them judge."""
study_options = stack(
    base_psnr_option, photos_options, select_option, drawing_options, drop_invalid_option, run_options
)
"""What every study has."""
results_option = option(
    "Output", "-o", "--output", metavar="DIR", required=True, help="Folder for the results; made if missing."
)
"""Where a study writes."""
