"""Help pages: options under headings. Rarely used options appear only with `--expert`.

Groups of subcommands import a subcommand only to run it.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import import_module
from typing import Any, TypeVar

import click

Decorated = TypeVar("Decorated", bound=Callable[..., Any])

INPUT = "Input"
VIEWS = "Views"
EFFORT = "Effort"
DEVICE = "Memory and device"
MACHINES = "Memory and machines"
OUTPUT = "Output"
METHOD = "Method"  # Heading of options that only one `--method` knows. The name of the method follows it.
FAULTS = "Faults"
HELP = "Help"

_LAST = (INPUT, VIEWS, EFFORT, DEVICE, MACHINES, OUTPUT, METHOD, f"{METHOD} best", f"{METHOD} paper", FAULTS, HELP)
"""Order of the headings that commands share. A command's own headings come before them."""
_NAMES_WIDTH = 22
"""Width of the column of option names. A longer name gets its own line, so that texts keep their width."""
_EXPERT = "flexgs_edge.expert"  # Key in `meta` of a context that says whether `--expert` was given


class LazyGroup(click.Group):
    """A group that knows the names of its subcommands, and imports their modules only to run one.

    `modules`: define the subcommands by their names. `lines`: the overview's line for each name.
    """

    def __init__(self, *args: Any, modules: Sequence[str], lines: Mapping[str, str], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.modules, self.lines = modules, lines

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.lines)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.lines:
            return None
        found = (getattr(import_module(module), cmd_name, None) for module in self.modules)
        return next(command for command in found if isinstance(command, click.Command))

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(self.lines.items()))
        click.Command.format_options(self, ctx, formatter)


class SectionOption(click.Option):
    """An option that appears under a heading in `--help`."""

    def __init__(self, *args: Any, section: str, **kwargs: Any) -> None:
        self.section = section
        super().__init__(*args, **kwargs)

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return the names and the help text. A pair of flags appears as `--[no-]name`."""
        record = super().get_help_record(ctx)
        if record is None or not self.secondary_opts:
            return record
        return f"--[no-]{self.opts[0].removeprefix('--')}", record[1]


def option(section: str, *names: str, **kwargs: Any) -> Callable[[Decorated], Decorated]:
    """Make a `click.option` that appears under a heading. Its default is shown, unless it is a flag or has none."""
    kwargs.setdefault("show_default", not isinstance(kwargs.get("default"), (bool, type(None))))
    return click.option(*names, cls=SectionOption, section=section, **kwargs)


input_option, views_option = partial(option, INPUT), partial(option, VIEWS)
output_option, device_option = partial(option, OUTPUT), partial(option, DEVICE)


def stack(*decorators: Callable[[Any], Any]) -> Callable[[Decorated], Decorated]:
    """Combine decorators into one, in the order in which `--help` shows them."""

    def apply(function: Decorated) -> Decorated:
        for decorator in reversed(decorators):
            function = decorator(function)
        return function

    return apply


class SectionCommand(click.Command):
    """A command whose `--help` shows options under headings."""

    def shown(self, ctx: click.Context) -> Sequence[click.Parameter]:
        """Return the options that the page shows, in order."""
        return self.get_params(ctx)

    def sections(self, ctx: click.Context) -> dict[str, list[click.Option]]:
        """Return the headings in order, and the options under each."""
        found: dict[str, list[click.Option]] = {}
        for parameter in self.shown(ctx):
            if isinstance(parameter, click.Option) and not parameter.hidden:
                found.setdefault(self.heading(parameter), []).append(parameter)
        return dict(sorted(found.items(), key=lambda item: _LAST.index(item[0]) if item[0] in _LAST else -1))

    def heading(self, parameter: click.Option) -> str:
        """Return the heading of an option."""
        return getattr(parameter, "section", HELP)

    def note(self, heading: str) -> str:
        """Return the text between a heading and its options; empty by default."""
        return ""

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        for heading, options in self.sections(ctx).items():
            with formatter.section(heading):
                if note := self.note(heading):
                    formatter.write_text(note)
                records = [parameter.get_help_record(ctx) for parameter in options]
                formatter.write_dl([record for record in records if record is not None], col_max=_NAMES_WIDTH)


class ExpertCommand(SectionCommand):
    """A command with many options: `--help` shows the common ones, `--expert` shows all.

    `usual`: names of the parameters that `--help` shows, in order. `more`: text that `--expert` shows below the options.
    """

    def __init__(self, *args: Any, usual: Sequence[str], more: str, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.usual, self.more = usual, more
        self.params.append(
            SectionOption(
                ["--expert"],
                section=HELP,
                is_flag=True,
                is_eager=True,
                expose_value=False,
                callback=_show_expert,
                help="Show all options, the rarer ones too, and exit.",
            )
        )

    def shown(self, ctx: click.Context) -> Sequence[click.Parameter]:
        known = {parameter.name: parameter for parameter in self.get_params(ctx)}
        usual = [known.pop(name) for name in self.usual]
        # --expert comes last under its heading, after click's own --help.
        expert = known.pop("expert")
        if not ctx.meta.get(_EXPERT):
            known = {name: each for name, each in known.items() if not isinstance(each, SectionOption)}
        return [*usual, *known.values(), expert]

    def heading(self, parameter: click.Option) -> str:
        heading = super().heading(parameter)
        owner = _method_only().get(str(parameter.name)) if heading == METHOD else None
        return heading if owner is None else f"{METHOD} {owner[0]}"

    def note(self, heading: str) -> str:
        word, _, method = heading.partition(" ")
        if word != METHOD or not method:
            return ""
        known = {str(parameter.name): parameter for parameter in self.params}
        owned = [known[name] for name, (owner, _) in _method_only().items() if owner == method]
        elsewhere = [each.opts[0] for each in owned if getattr(each, "section", HELP) != METHOD]
        default = " (the default)" if known["method"].default == method else ""
        also = f" So do {', '.join(elsewhere[:-1])} and {elsewhere[-1]}." if elsewhere else ""
        return f"These need --method {method}{default}.{also}"

    def format_epilog(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        if ctx.meta.get(_EXPERT):
            formatter.write_paragraph()
            formatter.write_text(self.more)


def _method_only() -> Mapping[str, tuple[str, object]]:
    # Imported here because it loads NumPy, which only the `--expert` page needs.
    from flexgs_edge.run.options import METHOD_ONLY

    return METHOD_ONLY


def _show_expert(ctx: click.Context, parameter: click.Parameter, value: bool) -> None:
    """Print the help with all options and exit, as `--help` does."""
    if value and not ctx.resilient_parsing:
        ctx.meta[_EXPERT] = True
        click.echo(ctx.get_help(), color=ctx.color)
        ctx.exit()
