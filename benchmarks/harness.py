"""Shared by all benchmarks: scenes, repeats and medians, and one JSON line for each result."""

from __future__ import annotations

import argparse
import csv
import functools
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.memory.process import peak_rss
from flexgs_edge.render.renderer import Renderer

ROOT = Path(__file__).resolve().parents[1]
SCENES = {
    "fox": Path(os.environ.get("FLEXGS_SCENES", ROOT.parent / "shared" / "scenes")) / "fox",
    "sample": ROOT / "samples" / "still_life",
}


class CheckFailed(Exception):
    """Raised when the result to be timed is wrong."""


def check(holds: bool, what: str) -> None:
    """Raise `CheckFailed` unless `holds`. Call this before timing anything."""
    if not holds:
        raise CheckFailed(what)


def add_row(place: Path, columns: Sequence[str], row: Mapping[str, object]) -> None:
    """Append a line to a CSV file. A new file gets its head first."""
    new = not place.exists()
    with open(place, "a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, lineterminator="\n")
        if new:
            writer.writeheader()
        writer.writerow(row)


@dataclass(frozen=True)
class Result:
    """One figure.

    Parameters
    ----------
    label : str
        What was measured.
    median, low, high : float
        Median, least and largest value of the repeats, in `unit`.
    repeats : int
        How often it was measured.
    peak_bytes : int
        Largest resident memory of the process that measured it.
    note : str
        What was checked, and the state of the kernel cache.
    """

    label: str
    median: float
    low: float
    high: float
    unit: str
    repeats: int
    peak_bytes: int
    revision: str
    device: str
    note: str = ""


@functools.lru_cache(maxsize=1)
def revision() -> str:
    """The checkout's commit, with a + if files were changed since."""
    done = subprocess.run(["git", "describe", "--always", "--dirty=+"], cwd=ROOT, capture_output=True, text=True)
    return done.stdout.strip() or "unknown"


class Timer:
    """Prints each result as a JSON line as soon as it is known.

    Parameters
    ----------
    device : str
        Name of the device, for the results.
    repeats : int
        How often everything is measured.
    """

    def __init__(self, device: str, repeats: int) -> None:
        self.device = device
        self.repeats = repeats

    def add(self, label: str, values: Sequence[float], unit: str, note: str = "", peak: int | None = None) -> None:
        """Print a result from the values of its repeats."""
        median, low, high = (float(f"{v:.4g}") for v in (statistics.median(values), min(values), max(values)))
        result = Result(
            label,
            median,
            low,
            high,
            unit,
            len(values),
            peak_rss() if peak is None else peak,
            revision(),
            self.device,
            note,
        )
        print(json.dumps(result.__dict__), flush=True)

    def time(self, label: str, run: Callable[[], Any], unit: str = "ms", per: float = 1.0, note: str = "") -> None:
        """Print the wall time of `run`, divided by `per`. One run before does not count."""
        run()
        scale = {"s": 1.0, "ms": 1e3, "us": 1e6, "ns": 1e9}[unit.split("/")[0]] / per
        values = []
        for _ in range(self.repeats):
            start = time.perf_counter()
            run()
            values.append((time.perf_counter() - start) * scale)
        self.add(label, values, unit, note)


def parse(
    doc: str | None, repeats: int, scene: str = "fox", more: Sequence[tuple[str, dict[str, Any]]] = ()
) -> argparse.Namespace:
    """Parse the options of all benchmarks, and `more` of one: names and arguments for `add_argument`."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", choices=SCENES, default=scene, help="default: %(default)s")
    parser.add_argument("--device", help="as for flexgs-edge; default: the device that it would take")
    parser.add_argument("--repeats", type=int, default=repeats, help="default: %(default)s")
    parser.add_argument("--first-image", action="store_true", help=argparse.SUPPRESS)
    for name, arguments in more:
        parser.add_argument(name, **arguments)
    options = parser.parse_args()
    if not (SCENES[options.scene] / "point_cloud.ply").is_file():
        parser.error(f"no scene at {SCENES[options.scene]}: set FLEXGS_SCENES to the folder that holds `fox`")
    return options


def backend_of(options: argparse.Namespace) -> tuple[Backend, MemoryBudget]:
    """The backend, with a budget as large as the machine allows."""
    budget = MemoryBudget.from_limit(None)
    return open_backend(options.device, budget), budget


def run_module(name: str, *arguments: str, environment: dict[str, str] | None = None) -> str:
    """Run `python -m benchmarks.NAME` in its own process; returns its standard output."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *arguments]
    done = subprocess.run(
        command, cwd=ROOT, env={**os.environ, **(environment or {})}, stdout=subprocess.PIPE, text=True
    )
    if done.returncode:
        raise SystemExit(done.returncode)
    return done.stdout


def table(lines: Sequence[str]) -> str:
    """JSON lines as a table for people."""
    rows = [("benchmark", "median", "low", "high", "unit", "n", "peak MiB", "note")]
    for line in lines:
        r = json.loads(line)
        figures = [f"{r[key]:g}" for key in ("median", "low", "high")]
        rows.append((r["label"], *figures, r["unit"], str(r["repeats"]), str(r["peak_bytes"] >> 20), r["note"]))
    widths = [max(len(row[k]) for row in rows) for k in range(len(rows[0]) - 1)]
    text = [" | ".join([*(cell.ljust(width) for cell, width in zip(row, widths)), row[-1]]) for row in rows]
    if lines:
        last = json.loads(lines[-1])
        text.append(f"revision {last['revision']}, {last['device']}")
    return "\n".join(text)


def read_sums(renderer: Renderer, sums: Any, channels: int, count: int) -> np.ndarray:
    """[channels, count] i64, the first planes of the last view's sums, for all rows of the scene."""
    rows = renderer.view_rows
    words = np.empty((count if rows is None else len(rows), sums.shape[1], 2), np.uint32)
    values = renderer.backend.read(sums, words).view(np.int64)[:, :channels, 0].T
    if rows is None:
        return values
    whole = np.zeros((channels, count), np.int64)
    whole[:, rows] = values
    return whole
