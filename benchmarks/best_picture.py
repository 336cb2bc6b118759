"""Draws docs/images/best.png: how `best` compresses the bundled scene, from the records of real runs.

    python -m benchmarks.best_picture                  # about a minute on two cores

The left chart shows the bytes after each decision of `--effort balanced`. The right chart shows every candidate that the
search of each effort measured.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

from benchmarks.harness import ROOT

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SCENE = ROOT / "samples" / "still_life" / "point_cloud.ply"
PICTURE = ROOT / "docs" / "images" / "best.png"
EFFORTS = {"fast": "#E69F00", "balanced": "#0072B2"}
FLOAT = 4
"""Bytes of a value in a PLY."""
INK, GREY = "#222222", "#b9c1c9"


def run(*words: str | Path) -> None:
    """Run the program in its own process."""
    subprocess.run(
        [sys.executable, "-m", "flexgs_edge", *map(str, words)], cwd=ROOT, stdout=subprocess.DEVNULL, check=True
    )


def records(effort: str, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """The JSON records of `compress` and of `info`."""
    file, search, contents = (folder / f"{effort}{suffix}" for suffix in (".fgs", ".json", "-info.json"))
    run("compress", SCENE, "-o", file, "--effort", effort, "--json", search, "-q")
    run("info", file, "--json", contents)
    return json.loads(search.read_text()), json.loads(contents.read_text())


def draw_bytes(axes: Axes, search: dict[str, Any], contents: dict[str, Any]) -> None:
    """Draw the bytes of a PLY after each decision, and the bytes of the file."""
    given, kept = search["input"], search["count"]
    row = given["ply_bytes"] // given["count"]
    bare = row - 3 * ((given["sh_degree"] + 1) ** 2 - 1) * FLOAT
    channels = contents["channels"]
    sh = sum(3 * (2 * d + 1) * FLOAT * channels[f"sh {d}"]["rows"] for d in range(1, contents["sh_degree"] + 1))
    stages = [
        (f"the scene: {given['count']:,} Gaussians", given["ply_bytes"]),
        (f"{kept:,} kept, by their measured cost", kept * row),
        (f"SH on {search['sh_count']:,} of them", kept * bare + sh),
        ("on grids, entropy coded", search["size"]),
    ]
    colours = [GREY] * (len(stages) - 1) + [EFFORTS["balanced"]]
    axes.barh(range(len(stages)), [size / 1e6 for _, size in stages], color=colours, height=0.45)
    for place, (words, size) in enumerate(stages):
        shown = f"{size / 1e6:.2f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
        axes.text(0.011, place - 0.33, f"{words}: {shown}", color=INK, va="bottom")
    axes.set(xscale="log", xlim=(0.01, 12), ylim=(len(stages) - 0.5, -0.8), yticks=[], xlabel="MB")
    axes.set_title("What stays (balanced)", loc="left")


def draw_search(axes: Axes, searches: dict[str, dict[str, Any]]) -> None:
    """Draw every candidate. It is filled if the target holds, and has a ring if it is the answer."""
    for effort, search in searches.items():
        steps, colour = search["search"], EFFORTS[effort]
        sizes, drops = [step["size"] / 1e3 for step in steps], [step["drop"] for step in steps]
        fills = [colour if step["holds"] else "white" for step in steps]
        axes.plot(sizes, drops, color=colour, linewidth=0.7, alpha=0.5, zorder=1)
        axes.scatter(sizes, drops, c=fills, edgecolors=colour, s=30, zorder=2)
        axes.scatter([], [], color=colour, s=30, label=f"{effort}: a file of {search['size'] / 1e3:.0f} kB")
        best = min((step for step in steps if step["holds"]), key=lambda step: step["size"])
        axes.scatter(best["size"] / 1e3, best["drop"], s=110, facecolors="none", edgecolors=INK, zorder=3)
    axes.axhline(1.0, color="#D55E00", linewidth=1, linestyle="--")
    axes.text(axes.get_xlim()[1], 1.01, "target: 1 dB", color="#D55E00", ha="right", va="bottom")
    axes.set(xlabel="kB", ylabel="drop against the photos, dB")
    axes.set_title("Candidates (filled: within the target; ringed: the answer)", loc="left")
    axes.legend(loc="lower left")


def main() -> None:
    """Run the program and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--png", type=Path, default=PICTURE)
    options = parser.parse_args()
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    with tempfile.TemporaryDirectory() as folder:
        found = {effort: records(effort, Path(folder)) for effort in EFFORTS}
    plt.rcParams.update({"font.size": 8.5, "axes.titlesize": 9.5, "legend.frameon": False})
    plt.rcParams.update({"axes.spines.top": False, "axes.spines.right": False})
    figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    draw_bytes(left, *found["balanced"])
    draw_search(right, {effort: search for effort, (search, _) in found.items()})
    figure.savefig(options.png, dpi=130, metadata={"Software": None})


if __name__ == "__main__":
    main()
