"""Draws the chart of the presets in README.md: ratio by processor time, from the measured rows of docs/results/figures.csv.

python -m benchmarks.presets_chart
"""

from __future__ import annotations

from benchmarks.figures import EFFORTS, SHOWN, Row, read_rows
from benchmarks.harness import ROOT
from flexgs_edge.report.plots import LineChart, Series, picture

IMAGE = ROOT / "docs" / "images" / "presets.png"
LABELS = {"compress --method paper": "paper", "compress --effort fast": "fast", "compress": "balanced"}
"""What each command of `EFFORTS` is called in the chart, the fastest first."""


def chart(rows: list[Row]) -> LineChart:
    """One line for each scene, one point for each preset."""
    found = {(row["scene"], row["command"]): row for row in rows}
    assert set(LABELS) == set(EFFORTS)
    series = []
    for scene in SHOWN:
        own = [(label, found[scene, command]) for command, label in LABELS.items() if (scene, command) in found]
        series.append(
            Series(
                scene,
                [float(row["cpu_seconds"]) for _, row in own],
                [float(row["ratio"]) for _, row in own],
                notes=[label for label, _ in own],
            )
        )
    return LineChart(
        "At most 1 dB lost, under the whole promise",
        "processor seconds",
        "times smaller than the PLY",
        tuple(series),
        log_x=True,
    )


if __name__ == "__main__":
    IMAGE.write_bytes(picture(chart(read_rows()))[0])
    print(f"{IMAGE.relative_to(ROOT)}: written")
