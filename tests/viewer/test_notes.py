"""Notes of a page: what a file of them may say, and where they stand in a page."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.commands.view import NOTES_MOST, read_notes, view
from flexgs_edge.errors import InputError
from grid_scenes import make_grid

GOOD = {"at": [1, 2.5, -3], "text": "</script><b>"}


def written(folder: Path, value: Any) -> Path:
    place = folder / "notes.json"
    place.write_text(value if isinstance(value, str) else json.dumps(value))
    return place


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ("[", r"notes.json: not JSON: .* in line 1"),
        ({"at": [0, 0, 0]}, "notes.json: expected a list of notes, found an object"),
        ([GOOD, 5], "notes.json: note 2: expected an object, found a number"),
        ([GOOD, {"text": "a"}], "notes.json: note 2: missing key 'at'; found 'text'"),
        ([{"at": [0, 0], "text": "a"}], r"note 1: at: expected 3 finite numbers, found \\[0, 0\\]"),
        ([{"at": [0, 0, True], "text": "a"}], "note 1: at: expected 3 finite numbers"),
        ('[{"at": [0, 0, 1e999], "text": "a"}]', "note 1: at: expected 3 finite numbers"),
        ([{"at": [0, 0, 0], "text": " "}], "note 1: text: expected a text, found ' '"),
        ([{"at": [0, 0, 0], "text": 3}], "note 1: text: expected a text, found 3"),
        ([GOOD] * (NOTES_MOST + 1), "expected at most 1000 notes, found 1001"),
    ],
)
def test_notes_that_are_refused(tmp_path: Path, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message.replace("\\\\", "\\")):
        read_notes(written(tmp_path, value))


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none.json: cannot read the notes"):
        read_notes(tmp_path / "none.json")


def test_they_stand_in_the_page_and_in_the_folder(tmp_path: Path) -> None:
    scene, notes = tmp_path / "scene.fgs", written(tmp_path, [GOOD])
    write_grid(scene, make_grid(300, 1), {})
    for output in (tmp_path / "page.html", tmp_path / "site"):
        view(scene, output, notes=notes, cameras="none")
        page = (output / "index.html" if output.is_dir() else output).read_text()
        config = re.search(r'id="scene">(.*?)</script>', page)
        assert config is not None and json.loads(config[1])["notes"] == [GOOD]
        assert "<b>" not in page and "GrayText" in page
    assert json.loads((tmp_path / "site" / "notes.json").read_text()) == [GOOD]
    view(scene, tmp_path / "plain.html", cameras="none")
    assert "GrayText" not in (tmp_path / "plain.html").read_text()
