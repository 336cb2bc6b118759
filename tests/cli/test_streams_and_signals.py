"""A terminal that goes away: standard streams that are closed, and SIGHUP."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flexgs_edge.cli import app
from flexgs_edge.io.ply import write_ply
from synthetic import random_scene

ROOT = str(Path(app.__file__).parents[2])
ENVIRONMENT = {**os.environ, "PYTHONPATH": ROOT}


@pytest.mark.parametrize("closed", ["0<&-", "1>&-", "2>&-", "0<&- 1>&- 2>&-"])
def test_closed_streams_are_streams_to_nowhere(tmp_path: Path, closed: str) -> None:
    write_ply(tmp_path / "a.ply", random_scene(50, 1, 0))
    command = f"exec {sys.executable} -m flexgs_edge decompress a.ply -o b.splat --device numpy {closed}"
    done = subprocess.run(["sh", "-c", command], cwd=tmp_path, env=ENVIRONMENT, timeout=120, capture_output=True)
    assert done.returncode == 0, done.stderr
    # A stream's number that is free would go to the next file that is opened, and words would be written into it.
    assert (tmp_path / "b.splat").stat().st_size == 50 * 32


@pytest.mark.parametrize("ignored", [False, True], ids=["usual", "nohup"])
def test_hangup_leaves_nothing_behind(tmp_path: Path, ignored: bool) -> None:
    write_ply(tmp_path / "a.ply", random_scene(300, 1, 0))
    # A command that waits between the beginning and the end of its file.
    program = (
        "import sys, time, flexgs_edge.cli.app as app, flexgs_edge.commands.decompress as d\n"
        "from flexgs_edge.files import atomic_write\n"
        "def slow(*args, **words):\n"
        "    with atomic_write('b.ply') as file:\n"
        "        file.write(b'half')\n"
        "        print('begun', flush=True)\n"
        "        time.sleep(1.5)\n"
        "    raise SystemExit(7)\n"
        "d.decompress = slow\n"
        "app.main(['decompress', 'a.ply', '-o', 'b.ply'])\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=tmp_path, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_IGN if ignored else signal.SIG_DFL),
    )  # fmt: skip
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    time.sleep(0.1)
    process.send_signal(signal.SIGHUP)
    assert process.wait(60) == (7 if ignored else 128 + signal.SIGHUP)
    process.stdout.close()
    assert {file.name for file in tmp_path.iterdir()} == ({"a.ply", "b.ply"} if ignored else {"a.ply"})
