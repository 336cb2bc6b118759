"""Kills `compress --resume` (kill -9) at random moments and resumes it.

Only files for the next run may stay behind, and the result must have the bytes of an uninterrupted run.

python -m benchmarks.kills [--kills 10] [--seed 0] [--memory-limit SIZE] [--scene fox|sample]
"""

from __future__ import annotations

import argparse
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import ROOT, SCENES, check

COMMAND = (sys.executable, "-m", "flexgs_edge", "compress")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))}
OURS = (".flexgs-resume-", ".flexgs-out-")
"""Beginnings of names of files that a killed run may leave for the next one."""


def compress(scene: Path, output: Path, words: Sequence[str], seconds: float | None = None) -> bool:
    """Run in a new process; returns whether it ended within `seconds`. Otherwise it is killed."""
    command = [
        *COMMAND,
        str(scene / "point_cloud.ply"),
        "-o",
        str(output),
        "--images",
        "none",
        "-q",
        "--effort",
        "fast",
    ]
    try:
        done = subprocess.run(
            [*command, *words], capture_output=True, text=True, env=ENVIRONMENT, timeout=seconds, check=False
        )
    except subprocess.TimeoutExpired:  # subprocess has killed it with SIGKILL
        return False
    check(done.returncode == 0, f"{' '.join(command)} {' '.join(words)}:\n{done.stderr}")
    return True


def killed_and_resumed(scene: Path, folder: Path, words: Sequence[str], kills: int, seed: int) -> dict[str, object]:
    """Kill `kills` runs, one after the other. Each run resumes the one before, or starts again if that one ended."""
    started = time.perf_counter()
    compress(scene, folder / "plain.fgs", words)
    whole = time.perf_counter() - started
    expected = (folder / "plain.fgs").read_bytes()
    place = folder / "killed"
    place.mkdir()
    output, moments, finished, left = place / "a.fgs", random.Random(seed), 0, 0
    done = 0
    while done < kills:
        if compress(scene, output, [*words, "--resume", "-f"], moments.uniform(0, whole)):
            check(output.read_bytes() == expected, "bytes of a run that was killed before")
            output.unlink()
            finished += 1
            continue
        done += 1
        if output.exists():  # killed after the file got its name, but before the end of the process
            check(output.read_bytes() == expected, "no part of a file by the name of the output")
            output.unlink()
        names = os.listdir(place)
        check(all(name.startswith(OURS) for name in names), f"what a killed run left: {names}")
        left += bool(names)
    compress(scene, output, [*words, "--resume", "-f"])
    check(output.read_bytes() == expected, "bytes after the last kill")
    check(os.listdir(place) == ["a.fgs"], f"what is left at the end: {os.listdir(place)}")
    return {"kills": done, "seed": seed, "whole run": round(whole, 1), "left rounds": left, "finished": finished + 1}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=sorted(SCENES), default="sample")
    parser.add_argument("--kills", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--resolution", default="200", help="width of the views; default: %(default)s")
    parser.add_argument("--memory-limit", help="so small that the scene goes to scratch files")
    options = parser.parse_args()
    words = ["--resolution", options.resolution]
    words += ["--memory-limit", options.memory_limit] if options.memory_limit else []
    folder = Path(tempfile.mkdtemp(prefix="kills-"))
    try:
        found = killed_and_resumed(SCENES[options.scene], folder, words, options.kills, options.seed)
        print(json.dumps(found))
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
