"""Leaves one scene out: would constants that were chosen without a scene serve it as well?

python -m benchmarks.left_out run [--scene fox ...] [--constant pixels ...] [--csv docs/results/left_out.csv]
python -m benchmarks.left_out page

`run` compresses every scene by `balanced` at 1 dB, with the constants as they are and with one of them at another value at a
time, each in a process of its own. Rows that the file has already are not run again. `page` writes docs/results/left_out.md:
for each constant and scene, the value that is best in the worst one of the other scenes, and what it takes there.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks.figures import SCENES, Row, read_rows
from benchmarks.harness import ROOT, add_row
from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import TargetError
from flexgs_edge.methods.best.effort import EFFORTS

CSV, PAGE = ROOT / "docs" / "results" / "left_out.csv", ROOT / "docs" / "results" / "left_out.md"
COLUMNS = ("constant", "value", "scene", "bytes", "kept")
NOW = "now"
EFFORT = "balanced"
VALUES: dict[str, tuple[Any, ...]] = {
    "pixels": (20, 28),
    "passes": (6.0, 10.0),
    "keep": (0.75, 0.84),
    "bit_weight": (3.3, 6.6),
    "means_rate": (0.5e-4, 1.0e-4),
    "mean_views": (0.12, 0.5),
    "WIDTH": (0.25, 1.0),
    "REMOVAL_FACTOR": (1.0, 1.7),
    "SH_FACTOR": (1.4, 2.8),
    "GEOMETRY_REFITTED": (1.4, 2.8),
    "CHROMA": (1.4, 2.8),
    "PRUNED_DISTILLED": (1.3, 2.0),
    "POWER": (4.0, 5.6),
    "MARGIN_STRUCTURE": (0.03, 0.055),
}
"""Constants that the search by `balanced` rests on, by the names in the code, and other values of each."""
BROKEN = float("inf")
HEAD = """# Leave one scene out

Would a constant that was chosen without a scene serve it as well? For each constant that `balanced` rests on, and each scene:

- *chosen* is the value that is best in the worst one of the other scenes, among those measured. `now` is that of the code.
- The bytes are those on the scene that was left out: how many more than with the value that is best there, and than now.

Whole searches at 1 dB under the promise. Files of one scene vary by 3 to 7 % with the order in which descents look at views.

    python -m benchmarks.left_out run
    python -m benchmarks.left_out page

All runs: [left_out.csv](left_out.csv).

"""


def put(name: str, value: Any) -> None:
    """Give a constant another value, wherever it was imported: of the effort, of descents, or of a module."""
    plan = EFFORTS[EFFORT]
    if hasattr(plan, name):
        EFFORTS[EFFORT] = replace(plan, **{name: value})
        return
    modules = [module for key, module in sys.modules.items() if key.startswith("flexgs_edge.methods.best")]
    course = next(module.COURSE for module in modules if hasattr(module, "COURSE"))
    if hasattr(course, name):
        name, value = "COURSE", replace(course, **{name: value})
    found = [module for module in modules if hasattr(module, name)]
    assert found, f"{name}: no such constant"
    for module in found:
        setattr(module, name, value)


def size_of(scene: str) -> tuple[int, bool]:
    """Bytes of the file, and whether the promise is kept."""
    try:
        made = compress(SCENES[scene] / "point_cloud.ply", None, effort=EFFORT, max_drop=1.0, dry_run=True)
    except TargetError:
        return 0, False
    return made.size, True


def wanted(constants: list[str], scenes: list[str]) -> Iterator[Row]:
    """The rows to measure, without their results."""
    for constant, values in {NOW: (NOW,), **{name: VALUES[name] for name in constants}}.items():
        for value in values:
            for scene in scenes:
                yield {"constant": constant, "value": str(value), "scene": scene}


def run(place: Path, constants: list[str], scenes: list[str]) -> None:
    """Measure what the file lacks."""
    known = {(row["constant"], row["value"], row["scene"]) for row in read_rows(place)}
    for row in wanted(constants, scenes):
        if tuple(row.values()) in known:
            continue
        command = [sys.executable, "-m", "benchmarks.left_out", "one", *row.values()]
        size, kept = subprocess.run(command, stdout=subprocess.PIPE, text=True, cwd=ROOT, check=True).stdout.split()
        add_row(place, COLUMNS, row | {"bytes": size, "kept": kept})
        print(*row.values(), size, kept, flush=True)


def page(rows: list[Row]) -> str:
    """The page: for each constant and scene, the value chosen without it, and its bytes over the best ones and those of now."""
    lines = [
        "| constant | left out | chosen | bytes over the best there | over now | promise |",
        "|---|---|---|---|---|---|",
    ]
    now = _sizes([row for row in rows if row["constant"] == NOW])
    for constant in dict.fromkeys(row["constant"] for row in rows if row["constant"] != NOW):
        found = now | _sizes([row for row in rows if row["constant"] == constant])
        sizes = {value: some for value, some in found.items() if some.keys() == now[NOW].keys()}
        for left in now[NOW]:
            least = {scene: min(some[scene] for some in sizes.values()) for scene in now[NOW]}
            others = [scene for scene in least if scene != left]
            worst = {value: max(some[scene] / least[scene] for scene in others) for value, some in sizes.items()}
            chosen = min(worst, key=worst.__getitem__)
            shares = [sizes[chosen][left] / size - 1 for size in (least[left], now[NOW][left])]
            kept = "broken" if sizes[chosen][left] == BROKEN else "kept"
            lines.append(f"| `{constant}` | {left} | {chosen} | {shares[0]:+.1%} | {shares[1]:+.1%} | {kept} |")
    return HEAD + "\n".join(lines) + "\n"


def _sizes(rows: list[Row]) -> dict[str, dict[str, float]]:
    """Bytes by value and scene. Those of a broken promise are infinite."""
    sizes: dict[str, dict[str, float]] = {}
    for row in rows:
        sizes.setdefault(row["value"], {})[row["scene"]] = float(row["bytes"]) if row["kept"] == "True" else BROKEN
    return sizes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "page", "one"))
    parser.add_argument("one", nargs="*", help="of `one`, which `run` calls: constant, value, scene")
    parser.add_argument("--scene", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--constant", nargs="+", default=list(VALUES), choices=list(VALUES))
    parser.add_argument("--csv", type=Path, default=CSV)
    options = parser.parse_args()
    if options.what == "one":
        constant, value, scene = options.one
        if constant != NOW:
            put(constant, type(VALUES[constant][0])(value))
        print(*size_of(scene))
    elif options.what == "run":
        run(options.csv, options.constant, options.scene)
    else:
        PAGE.write_text(page(read_rows(options.csv)), encoding="utf-8")


if __name__ == "__main__":
    main()
