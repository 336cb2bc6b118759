"""Commands that hold no more than `--memory-limit`, at the limit that their first error names."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).parents[2] / "samples" / "still_life"
TOLERANCE = 1.02
"""Some parts of a run have bounds and are not counted to the byte: kernels that are built anew, stacks of threads."""


def run(words: list[str], limit: str) -> subprocess.CompletedProcess[str]:
    """The program in a process of its own, whose peak is that of this run."""
    command = [sys.executable, "-m", "flexgs_edge", *words, "--force", "--memory-limit", limit]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "output"),
    [
        (["compress", "--method", "paper"], "scene.fgs"),
        (["score"], "scores.npy"),
        (["render", "--views", "0,1,2"], "views"),
    ],
    ids=["paper", "score", "render"],
)
def test_the_named_limit_is_kept(words: list[str], output: str, tmp_path: Path) -> None:
    found = tmp_path / "found.json"
    command = [words[0], str(SAMPLE), *words[1:], "-o", str(tmp_path / output), "--json", str(found)]
    refused = run(command, "100MiB")
    assert refused.returncode == 5, refused.stderr
    limit = re.search(r"use --memory-limit (\d+MiB) or more, which counts later stages too", refused.stderr)
    assert limit, refused.stderr
    done = run(command, limit[1])
    assert done.returncode == 0, done.stderr
    memory = json.loads(found.read_text())["run"]
    assert memory["peak_memory"] < TOLERANCE * memory["memory_limit"]
