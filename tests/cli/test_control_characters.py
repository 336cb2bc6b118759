"""Strings of a file reach the terminal as text: no title, colour or cursor movement of somebody else's."""

from __future__ import annotations

from pathlib import Path

import pytest

from flexgs_edge.cli import app
from flexgs_edge.io.ply import write_ply
from synthetic import random_scene

HOSTILE = "\x1b]0;owned\x07\x1b[2J\r\u202eevil"


@pytest.mark.parametrize(
    "command", [["info"], ["decompress", "-o", "b.splat", "-f", "--device", "numpy"]], ids=" ".join
)
def test_comments_and_names_are_escaped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], command: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    name = f"{HOSTILE}.ply".replace("/", "")
    write_ply(tmp_path / name, random_scene(20, 1, 0))
    whole = (tmp_path / name).read_bytes()
    (tmp_path / name).write_bytes(whole.replace(b"end_header", f"comment {HOSTILE}\nend_header".encode(), 1))
    for arguments in ([command[0], name, *command[1:]], [command[0], f"no{name}", *command[1:]]):
        with pytest.raises(SystemExit):
            app.main(arguments)
        out, err = capsys.readouterr()
        text = (out + err).replace("\n", "").replace("\t", "")
        assert "\\x1b]0;owned\\x07" in text and "\\u202eevil" in text
        assert text.isprintable(), repr(text)
