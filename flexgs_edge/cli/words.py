"""Words that subcommands share: types of values, options, and how results leave."""

from __future__ import annotations

import logging
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import click

from flexgs_edge.budget import parse_size
from flexgs_edge.constants import DEFAULT_BASE_PSNR, DEFAULT_HOLDOUT, DEFAULT_NEAR, MAX_VIEW_WIDTH
from flexgs_edge.errors import InputError
from flexgs_edge.progress import Progress

Decorated = TypeVar("Decorated", bound=Callable[..., Any])
LAST = "Run"
"""The section of what every command has: shown after what is its own."""
COLOURS = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}


@dataclass
class State:
    """What `main` must know after a command has failed."""

    debug: bool = False


class SizeType(click.ParamType):
    """Bytes: `1.5MB` (10^6), `512MiB` (2^20) or plain."""

    name = "SIZE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        try:
            return value if isinstance(value, int) else parse_size(value)
        except InputError as error:
            self.fail(str(error), param, ctx)


class ColourType(click.ParamType):
    """Red, green, blue from 0 to 1."""

    name = "COLOUR"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
    ) -> tuple[float, float, float]:
        if isinstance(value, tuple):
            return value
        text = value.strip().lower()
        if text in COLOURS:
            return COLOURS[text]
        if re.fullmatch(r"#[0-9a-f]{6}", text):
            red, green, blue = (int(text[i : i + 2], 16) / 255 for i in (1, 3, 5))
            return red, green, blue
        parts = text.split(",")
        try:
            numbers = [float(part) for part in parts]
        except ValueError:
            numbers = []
        if len(numbers) != 3 or not all(0.0 <= number <= 1.0 for number in numbers):
            self.fail(f"{value!r}: expected black, white, #rrggbb, or red,green,blue from 0 to 1", param, ctx)
        return numbers[0], numbers[1], numbers[2]


class ViewsType(click.ParamType):
    """Indices of views: `0,8,16`, `0:50:8`, or both mixed."""

    name = "VIEWS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> list[int]:
        if isinstance(value, list):
            return value
        chosen: list[int] = []
        for part in value.split(","):
            match = re.fullmatch(r"\s*([0-9]{1,9})(?::([0-9]{1,9})(?::([1-9][0-9]{0,8}))?)?\s*", part)
            if match is None:
                self.fail(
                    f"{value!r}: expected numbers such as 0,8,16 or START:STOP:STEP such as 0:50:8 (STOP left out)",
                    param,
                    ctx,
                )
            start, stop, step = match.groups()
            # Bounded before the list is made: a typing slip must not fill the memory.
            last = min(int(stop), 1_000_000) if stop else int(start) + 1
            chosen.extend(range(int(start), last, int(step or 1)))
        return chosen


SIZE, COLOUR, VIEWS = SizeType(), ColourType(), ViewsType()


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


def _set_debug(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and isinstance(ctx.obj, State):
        ctx.obj.debug = True


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
        callback=_set_debug,
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


def start(quiet: bool, json_path: str | None = None, force: bool = False, report: str | None = None) -> Progress:
    """Set up the log on stderr and check the JSON file before any work; progress bars for the job."""
    log = logging.getLogger("flexgs_edge")
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(logging.Formatter("flexgs-edge: %(message)s"))
    log.handlers = [handler]
    log.setLevel(logging.WARNING if quiet else logging.INFO)
    log.propagate = False
    if json_path not in (None, "-"):
        from flexgs_edge.scene.atomic import check_writable

        if report is not None and Path(str(json_path)).resolve() == (Path(report) / "result.json").resolve():
            raise InputError(f"--json {json_path}: --report {report} writes this file already; leave --json out")
        check_writable(str(json_path), force)
    return Progress(enabled=False if quiet else None)


def emit(text: str, record: dict[str, Any], json_path: str | None, force: bool = False) -> None:
    """The summary to stdout; with `--json -` the JSON takes its place and the summary goes to stderr."""
    click.echo(text, nl=False, err=json_path == "-")
    if json_path is None:
        return
    from flexgs_edge.report.result import json_text

    words = json_text(record)
    if json_path == "-":
        click.echo(words, nl=False)
        return
    from flexgs_edge.scene.atomic import atomic_write

    with atomic_write(json_path, force) as file:
        file.write(words.encode())
