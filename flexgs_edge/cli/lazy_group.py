"""Groups whose subcommands are imported when they are run."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import Any

import click


class LazyGroup(click.Group):
    """A group that knows the names of its subcommands, and imports a subcommand only to run it.

    `commands_from`: a package with one module per subcommand, each of which defines `command`, or a module that defines
    all subcommands; and the overview's line for each name.
    """

    def __init__(self, *args: Any, commands_from: tuple[str, Mapping[str, str]], **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.package, self.lines = commands_from

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(self.lines)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in self.lines:
            return None
        found = getattr(import_module(self.package), cmd_name, None)
        command: click.Command = (
            found if isinstance(found, click.Command) else import_module(f"{self.package}.{cmd_name}").command
        )
        return command

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        self.format_commands(ctx, formatter)
        click.Command.format_options(self, ctx, formatter)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        with formatter.section("Commands"):
            formatter.write_dl(list(self.lines.items()))
