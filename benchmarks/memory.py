"""Runs `compress` under memory caps that the kernel enforces; records each run in a CSV file and draws a chart of peaks.

python -m benchmarks.memory run SCENE.ply --cameras POSES.json [--cap 512MiB --limit 480MiB] [--csv docs/results/memory.csv]
python -m benchmarks.memory draw [--csv docs/results/memory.csv] [--png docs/images/memory.png]
"""

from __future__ import annotations

import argparse
import csv
import hashlib
import json
import re
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from benchmarks.harness import ROOT, add_row, check
from flexgs_edge.report.plots import LineChart, Series, picture
from flexgs_edge.units import parse_size

CSV, PNG = ROOT / "docs" / "results" / "memory.csv", ROOT / "docs" / "images" / "memory.png"
COLUMNS = (
    "gaussians", "cap", "limit", "seconds", "processor_seconds", "group_peak", "anonymous_peak", "resident_peak", "scratch",
    "bytes", "sha256",
)  # fmt: skip
"""Columns of the CSV file; sizes in bytes. `cap`, `limit`, `group_peak`, `anonymous_peak` and `scratch` may be empty."""
MIB = 1 << 20


def run(scene: Path, cameras: Path, cap: str | None, limit: str | None) -> dict[str, object]:
    """Run once with `--effort fast`, in a control group if there is a cap; returns figures by `COLUMNS`."""
    with tempfile.TemporaryDirectory(prefix="memory-", dir=scene.parent) as folder:
        output, record = Path(folder) / "a.fgs", Path(folder) / "a.json"
        command = [*([str(ROOT / "deploy" / "capped-run.sh"), cap] if cap else []), sys.executable, "-m", "flexgs_edge"]
        command += ["compress", str(scene), "-o", str(output), "--json", str(record), "--effort", "fast", "-q"]
        command += ["--cameras", str(cameras), "--images", "none", *(["--memory-limit", limit] if limit else [])]
        started, before = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
        took, after = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        check(done.returncode == 0, done.stderr)
        group = re.search(r"==> peak: ([0-9]+) bytes", done.stderr)
        found = json.loads(record.read_text())
        return {
            "gaussians": found["input"]["count"],
            "cap": parse_size(cap) if cap else None,
            "limit": parse_size(limit) if limit else None,
            "seconds": round(took, 1),
            "processor_seconds": round(after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, 1),
            "group_peak": group.group(1) if group else None,
            "anonymous_peak": found["run"]["peak_anonymous"],
            "resident_peak": found["run"]["peak_memory"],
            "scratch": found["run"]["scratch"],
            "bytes": output.stat().st_size,
            "sha256": hashlib.sha256(output.read_bytes()).hexdigest(),
        }


def chart(rows: Sequence[dict[str, str]]) -> LineChart:
    """A chart of peaks in MiB over thousands of Gaussians."""
    rows = sorted(rows, key=lambda row: int(row["gaussians"]))

    def series(label: str, column: str, capped: bool) -> Series:
        some = [row for row in rows if bool(row["cap"]) is capped and row[column]]
        x, y = ([int(row[name]) / unit for row in some] for name, unit in (("gaussians", 1000), (column, MIB)))
        return Series(label, x, y)

    return LineChart(
        "Peak memory of compress by Gaussians",
        "thousands of Gaussians",
        "MiB",
        (
            series("without a limit: resident", "resident_peak", False),
            series("under a cap: memory without a file behind it", "anonymous_peak", True),
            series("the cap", "cap", True),
        ),
        log_x=True,
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "draw"))
    parser.add_argument("scene", type=Path, nargs="?")
    parser.add_argument("--cameras", type=Path)
    parser.add_argument("--cap")
    parser.add_argument("--limit")
    parser.add_argument("--csv", type=Path, default=CSV)
    parser.add_argument("--png", type=Path, default=PNG)
    options = parser.parse_args()
    if options.what == "draw":
        with open(options.csv, newline="", encoding="utf-8") as file:
            options.png.write_bytes(picture(chart(list(csv.DictReader(file))))[0])
        return
    if options.scene is None or options.cameras is None:
        parser.error("run: expected SCENE.ply and --cameras POSES.json")
    row = run(options.scene.resolve(), options.cameras.resolve(), options.cap, options.limit)
    add_row(options.csv, COLUMNS, row)
    print(json.dumps(row))


if __name__ == "__main__":
    main()
