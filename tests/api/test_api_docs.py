"""The examples of docs/api.md and docs/example_arrays.py run as they stand."""

from __future__ import annotations

import doctest
import re
import runpy
from pathlib import Path

import pytest

from tiny_project import make_project


def test_the_examples_of_the_page_run(
    repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(make_project(tmp_path / "scene"))
    # A fence behind an example would be read as its output.
    text = re.sub(r"^```.*$", "", (repository / "docs" / "api.md").read_text(), flags=re.MULTILINE)
    page = doctest.DocTestParser().get_doctest(text, {}, "api.md", "docs/api.md", 0)
    assert len(page.examples) > 25
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    runner.run(page)
    assert runner.summarize(verbose=False).failed == 0, capsys.readouterr().out


def test_the_example_runs(repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    runpy.run_path(str(repository / "docs" / "example_arrays.py"))["main"]()
    found = re.search(
        r"^(\d+) bytes; PSNR of the first view against the original's: ([\d.]+) dB$", capsys.readouterr().out, re.M
    )
    assert found is not None and int(found[1]) < 6000 and float(found[2]) > 35
