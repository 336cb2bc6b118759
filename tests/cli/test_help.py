"""Help pages: short, complete, without figures; the methods' options under the methods' names."""

from __future__ import annotations

import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from flexgs_edge.cli import app, compress
from flexgs_edge.cli.help_page import METHOD
from flexgs_edge.run.options import METHOD_ONLY

HIDDEN: tuple[str, ...] = ()
"""Options of `compress` that are accepted and on no page: at most five."""
FIGURE = re.compile(
    r"\d\s?(?:%|dB\b|s\b|(?:seconds?|minutes?|hours?|times)\b|[kMG]i?B\b)|\b(?:twice|thirds?|quarters?|fifths?)\b"
)
DEFAULT_OR_EXAMPLE = re.compile(
    r"\[default:[^\]]*\]|Default: [^.]*\.|such as [^.]*(?:\.\d[^.]*)*\.|^ *flexgs-edge .*", re.MULTILINE
)


def commands(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], click.Command]]:
    """The group, the groups below and every command, with their words."""
    yield words, command
    if isinstance(command, click.Group):
        with click.Context(command) as context:
            for name in command.list_commands(context):
                below = command.get_command(context, name)
                assert below is not None
                yield from commands(below, (*words, name))


COMMANDS = dict(commands(app.command))


def page(*words: str, capsys: pytest.CaptureFixture[str]) -> str:
    """What a command that ends by itself writes to stdout."""
    with pytest.raises(SystemExit) as left:
        app.main(words)
    assert left.value.code == 0
    return capsys.readouterr().out


def names(text: str) -> set[str]:
    """The options that a page lists; both words of `--[no-]name`."""
    lines = re.findall(r"^  (-\S.*?)(?:  |$)", text, re.MULTILINE)
    found = {word for line in lines for word in re.findall(r"--[\w\[][\w\[\]-]*", line)}
    pairs = {word for word in found if word.startswith("--[no-]")}
    return found - pairs | {word.replace("[no-]", no) for word in pairs for no in ("", "no-")}


def accepted(command: click.Command) -> set[str]:
    with click.Context(command) as context:
        options = [each for each in command.get_params(context) if isinstance(each, click.Option)]
        return {name for each in options for name in (*each.opts, *each.secondary_opts) if name.startswith("--")}


@pytest.mark.parametrize("columns", [80, 200])
def test_the_first_page_of_compress_is_short(
    columns: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    text = page("compress", "--help", capsys=capsys)
    assert len(text.splitlines()) <= 60
    shown = {name for name in names(text) if not name.startswith("--no-")} - {"--help", "--expert"}
    assert len(shown) == len(compress.USUAL) <= 20
    assert text.splitlines()[-1].split()[0] == "--expert" and "docs/results/speed.md" in text


def test_every_option_of_compress_is_on_a_page(capsys: pytest.CaptureFixture[str]) -> None:
    first = names(page("compress", "--help", capsys=capsys))
    everything = names(page("compress", "--expert", capsys=capsys))
    assert first < everything and everything | set(HIDDEN) == accepted(compress.compress) and len(HIDDEN) <= 5
    # An eager flag: nothing else has to be right.
    assert page("compress", "--max-drop", "1", "--expert", capsys=capsys).startswith("Usage: ")


@pytest.mark.parametrize("words", [words for words in COMMANDS if words != ("compress",)], ids=" ".join)
def test_every_option_of_the_others_is_on_their_page(
    words: tuple[str, ...], capsys: pytest.CaptureFixture[str]
) -> None:
    assert names(page(*words, "--help", capsys=capsys)) == accepted(COMMANDS[words])


@pytest.mark.parametrize("words", [*((*words, "--help") for words in COMMANDS), ("compress", "--expert")], ids=" ".join)
def test_no_page_has_a_figure(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    """Measurements change: docs/results has them, with the command that made them."""
    paragraphs = re.sub(r"\n {4,}(?!flexgs-edge)", " ", page(*words, capsys=capsys))
    assert FIGURE.findall(DEFAULT_OR_EXAMPLE.sub("", paragraphs)) == []


def test_a_figure_would_be_found() -> None:
    for text in ("30 to 40 % larger", "keeps 47 dB", "takes 3 s a view", "10 times smaller", "a third fewer bytes"):
        assert FIGURE.search(DEFAULT_OR_EXAMPLE.sub("", text))
    for text in ("such as 8MB or 8MiB.", "  flexgs-edge trim a.fgs --max-size 2MB", "[default: 2 s]", "N% of them"):
        assert not FIGURE.search(DEFAULT_OR_EXAMPLE.sub("", text))


def test_the_sections_of_methods_are_those_of_the_library(capsys: pytest.CaptureFixture[str]) -> None:
    """Under a method's heading, or with a heading of its own and named below the method's."""
    text = page("compress", "--expert", capsys=capsys)
    with click.Context(compress.compress) as context:
        context.meta["flexgs_edge.expert"] = True
        sections = compress.compress.sections(context)
    owners = {
        parameter: heading for heading, options in sections.items() for parameter in (each.name for each in options)
    }
    for method in ("best", "paper"):
        members = {name for name, (owner, _) in METHOD_ONLY.items() if owner == method}
        below = {name for name, heading in owners.items() if heading == f"{METHOD} {method}"}
        note = compress.compress.note(f"{METHOD} {method}")
        assert note in " ".join(text.split())
        named = {word.strip(".,").removeprefix("--").replace("-", "_") for word in note.split() if word[:2] == "--"}
        assert below | (named - {"method"}) == members and not below & named
    assert "best only" not in text and "paper only" not in text


@pytest.mark.parametrize("group", [(), ("study",)], ids=["top", "study"])
def test_the_overview_and_the_commands_say_the_same(group: tuple[str, ...]) -> None:
    lines = COMMANDS[group].lines  # type: ignore[attr-defined]
    assert lines == {name: (COMMANDS[(*group, name)].help or "").splitlines()[0] for name in lines}


def test_help_of_compress_loads_no_numpy(repository: Path) -> None:
    script = (
        "import sys; from flexgs_edge.cli.app import main\n"
        "try: main(['compress', '--help'])\nexcept SystemExit: sys.exit('numpy' in sys.modules)"
    )
    assert (
        subprocess.run([sys.executable, "-c", script], cwd=repository, capture_output=True, check=False).returncode == 0
    )
