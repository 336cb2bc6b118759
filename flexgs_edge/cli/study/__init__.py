"""`flexgs-edge study`: experiments, one module a subcommand."""

from flexgs_edge.cli.study.group import command

__all__ = ["command"]
