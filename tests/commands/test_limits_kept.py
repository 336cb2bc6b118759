"""Commands that hold no more than `--memory-limit`, at the limit that their first error names."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.memory.budget import ROOM
from grid_scenes import sample_grid

SAMPLE = Path(__file__).parents[2] / "samples" / "still_life"


def run(words: list[str], limit: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, whose peak is that of this run."""
    command = [sys.executable, "-m", "flexgs_edge", *words, "--force", "--memory-limit", limit]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "output"),
    [(["compress", "--method", "paper"], "scene.fgs"), (["render", "--views", "0,1,2"], "views")],
    ids=["paper", "render"],
)
def test_the_named_limit_is_kept(words: list[str], output: str, tmp_path: Path) -> None:
    check_limit([words[0], str(SAMPLE), *words[1:], "-o", str(tmp_path / output)], tmp_path / "found.json")


@pytest.fixture(scope="module")
def fine_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample with wide codes and with as many rows as there are, whose decoding takes much."""
    place = tmp_path_factory.mktemp("limits") / "fine.fgs"
    write_grid(place, sample_grid(SAMPLE, 1), {})
    return place


@pytest.mark.parametrize(
    "words",
    [
        ["compress", "{file}", "--method", "paper", "--best-effort", "-o", "{folder}/scene.fgs"],
        ["render", "{file}", "--views", "0,1,2", "-o", "{folder}/views"],
        ["evaluate", "{file}", "--against", str(SAMPLE)],
    ],
    ids=lambda words: words[0],
)
def test_the_named_limit_is_kept_while_a_file_is_decoded(words: list[str], fine_file: Path, tmp_path: Path) -> None:
    command = [word.format(file=fine_file, folder=tmp_path) for word in words]
    check_limit([*command, "--cameras", str(SAMPLE / "cameras.json")], tmp_path / "found.json")


def check_limit(command: list[str], found: Path) -> None:
    command = [*command, "--json", str(found)]
    refused = run(command, "100MiB")
    assert refused.returncode == 5, refused.stderr
    limit = re.search(r"use --memory-limit (\d+MiB) or more, which counts later stages too", refused.stderr)
    assert limit, refused.stderr
    done = run(command, limit[1])
    assert done.returncode == 0, done.stderr
    memory = json.loads(found.read_text())["run"]
    assert memory["peak_memory"] < memory["memory_limit"] + ROOM
