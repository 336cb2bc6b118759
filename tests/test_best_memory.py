"""`--method best` under a tight memory limit: refused with a limit that does, and its peak stays below that."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

from flexgs_edge.budget import parse_size
from flexgs_edge.pipeline.best import row_bytes
from flexgs_edge.scene import write_ply
from synthetic import random_scene
from tiny_project import write_cameras

ROWS = 25_000


def compress(folder: Path, limit: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "flexgs_edge", "compress", str(folder / "point_cloud.ply"), "-q", "-f"]
    command += ["-o", str(folder / "a.fgs"), "--json", str(folder / "a.json"), "--method", "best", "--effort", "fast"]
    command += ["--min-fidelity", "38", "--best-effort", "--memory-limit", limit]
    paths = os.pathsep.join(filter(None, sys.path))
    environment = {**os.environ, "PYTHONPATH": paths}
    return subprocess.run(command, capture_output=True, text=True, env=environment, timeout=200)


def test_the_peak_stays_below_the_limit_that_the_error_names(tmp_path: Path) -> None:
    write_ply(tmp_path / "point_cloud.ply", random_scene(ROWS, 8, 3, size=-4.0))
    write_cameras(tmp_path / "cameras.json")
    limits = ["230MiB"]
    for _ in range(3):
        done = compress(tmp_path, limits[-1])
        if done.returncode == 0:
            break
        named = re.search(r"use --memory-limit (\d+MiB) or more", done.stderr)
        assert named, done.stderr
        limits.append(named.group(1))
    assert done.returncode == 0 and len(limits) > 1, done.stderr
    record = json.loads((tmp_path / "a.json").read_text())
    # Nearly all of this scene is kept: what a result holds is as large as it can be.
    assert record["count"] > ROWS / 2
    assert record["run"]["peak_memory"] <= parse_size(limits[-1])


def test_more_snapshots_take_more() -> None:
    assert row_bytes(0, 0.66) < row_bytes(3, 0.66) <= row_bytes(3, 0.88) < row_bytes(3, 0.95)
    # At least the snapshots, each with the planes of its rows.
    assert row_bytes(3, 0.88) > 236 / 0.12
