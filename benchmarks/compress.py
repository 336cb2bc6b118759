"""Measures a whole run of `flexgs-edge compress`: wall time and peak memory, with a cold and a warm kernel cache.

python -m benchmarks.compress [--scene fox|sample] [--device SPEC] [--repeats N]
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.harness import ROOT, SCENES, Timer, check, parse


def compress(scene: str, device: str | None, folder: Path, cache: Path) -> tuple[float, int, dict[str, Any]]:
    """Seconds, peak resident bytes and the result's JSON of one run."""
    output, report = folder / "out.fgs", folder / "out.json"
    command = [
        sys.executable,
        "-m",
        "flexgs_edge",
        "compress",
        str(SCENES[scene] / "point_cloud.ply"),
        "-o",
        str(output),
    ]
    command += ["-f", "-q", "--json", str(report), *(["--device", device] if device else [])]
    environment = {**os.environ, "POCL_CACHE_DIR": str(cache)}
    start = time.perf_counter()
    process = subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    seconds = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    check(process.returncode == 0, f"compress ended with {process.returncode}")
    peak = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
    return seconds, peak, json.loads(report.read_text())


def main() -> None:
    options = parse(__doc__, repeats=3)
    cold: list[tuple[float, int, dict[str, Any]]] = []
    warm: list[tuple[float, int, dict[str, Any]]] = []
    sums = set()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for repeat in range(options.repeats):
            for runs in (cold, warm):
                runs.append(compress(options.scene, options.device, folder, folder / f"cache{repeat}"))
                sums.add((folder / "out.fgs").read_bytes())
        size = (folder / "out.fgs").stat().st_size
        verify = [sys.executable, "-m", "flexgs_edge", "verify", str(folder / "out.fgs")]
        check(subprocess.run(verify, cwd=ROOT, stdout=subprocess.DEVNULL).returncode == 0, "verify")
    check(len(sums) == 1, "the same bytes in every run")
    result = warm[0][2]
    device = result["run"]["device"]["name"] if result["run"]["device"] else "none"
    timer = Timer(device, options.repeats)
    note = f"{size} bytes in every run, verified"
    for label, runs in (("cold", cold), ("warm", warm)):
        peak = max(run[1] for run in runs)
        timer.add(f"compress, {label}", [run[0] for run in runs], "s", f"{note}; PoCL's kernel cache {label}", peak)
    for stage in result["run"]["stages"]:
        timer.add(
            f"compress: {stage}", [run[2]["run"]["stages"][stage] for run in warm], "s", "kernel cache warm", peak
        )


if __name__ == "__main__":
    main()
