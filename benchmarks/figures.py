"""Measures the figures of README and docs: runs of the command line go to one CSV file, and tables are made from it.

python -m benchmarks.figures run [--scene still_life ...] [--command "compress --effort fast" ...]
python -m benchmarks.figures tables [--check]
python -m benchmarks.figures picture

A table stands in a page between `<!-- figures: NAME -->` and `<!-- end -->`. `run` replaces rows of the same scene and command.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from PIL import Image, ImageDraw

from benchmarks.harness import ROOT, CheckFailed, check, revision

CSV, MEMORY_CSV = ROOT / "docs" / "results" / "figures.csv", ROOT / "docs" / "results" / "memory.csv"
COLUMNS = (
    "scene", "command", "bytes", "ratio", "drop_db", "fidelity_db", "worst_db", "worst_allowed_db", "ssim_lost", "flip",
    "decided", "seconds", "cpu_seconds", "peak_mib", "machine", "commit",
)  # fmt: skip
Row = dict[str, str]
SCENES_DIR = Path(os.environ.get("FLEXGS_SCENES", ROOT.parent / "shared" / "scenes"))
SHOWN = ("still_life", "fox", "figure")
"""The bundled scene, and two others that the repository lacks. Pages show these."""


def found_scenes() -> dict[str, Path]:
    """Scenes by name: those of `SHOWN`, and every other folder of FLEXGS_SCENES that has a scene, cameras and photos."""
    scenes = {name: SCENES_DIR / name for name in SHOWN}
    scenes["still_life"] = ROOT / "samples" / "still_life"
    others = sorted(SCENES_DIR.iterdir()) if SCENES_DIR.is_dir() else []
    needed = ("point_cloud.ply", "cameras.json", "images")
    return scenes | {p.name: p for p in others if p.name not in scenes and all((p / name).exists() for name in needed)}


SCENES = found_scenes()
DEFAULT = "compress"
EFFORTS = {
    DEFAULT: "default",
    "compress --effort fast": "`--effort fast`",
    "compress --method paper": "`--method paper`",
}
FORMATS = ("compress -o X.spz", "compress -o X.sog", "compress -o X.compressed.ply")
MEAN = ("compress --promise mean", "compress --method paper --promise mean")
COMMANDS = {
    **{command: tuple(SCENES) for command in EFFORTS},
    **dict.fromkeys(MEAN, tuple(SCENES)),
    **dict.fromkeys(FORMATS, ("still_life",)),
}
"""Commands to run, and the scenes of each."""
PICTURE, VIEW, LABEL = ROOT / "docs" / "images" / "still_life.jpg", "24", 26
NONE = "\u2013"


# Running


@dataclass(frozen=True)
class Taken:
    """One run: its record, its file, and the system's counts for the process and its children."""

    record: dict[str, Any]
    file: bytes
    seconds: float
    cpu_seconds: float
    peak_mib: float


def compress(scene: Path, command: str, folder: Path) -> tuple[Taken, Path]:
    """Run a command of `COMMANDS` once; returns the run and the file that it wrote."""
    words = shlex.split(command)
    output, record = folder / "out.fgs", folder / "out.json"
    if "-o" in words:
        place = words.index("-o")
        output = folder / words[place + 1]
        del words[place : place + 2]
    call = [sys.executable, "-m", "flexgs_edge", *words, str(scene / "point_cloud.ply"), "-o", str(output)]
    started = time.perf_counter()
    process = subprocess.Popen([*call, "-f", "-q", "--json", str(record)], cwd=ROOT, stdout=subprocess.DEVNULL)
    _, status, usage = os.wait4(process.pid, 0)
    took = time.perf_counter() - started
    process.returncode = os.waitstatus_to_exitcode(status)
    check(process.returncode == 0, f"{command} ended with {process.returncode}")
    unit = 1 << 20 if sys.platform == "darwin" else 1 << 10  # of ru_maxrss
    cpu = usage.ru_utime + usage.ru_stime
    found = Taken(json.loads(record.read_text()), output.read_bytes(), took, cpu, usage.ru_maxrss / unit)
    return found, output


def check_result(taken: Taken, output: Path) -> None:
    """Check that the file is whole, that the record is about it, and that the target is met."""
    reader = "verify" if output.suffix == ".fgs" else "info"
    done = subprocess.run(
        [sys.executable, "-m", "flexgs_edge", reader, str(output)], cwd=ROOT, stdout=subprocess.DEVNULL
    )
    check(done.returncode == 0, f"{reader} {output.name} ended with {done.returncode}")
    record = taken.record
    check(record["size"] == len(taken.file), f"{output.name}: the record says {record['size']} bytes")
    check(record["reached"] is True, f"{output.name}: the target is not met")


def measure(name: str, command: str, repeats: int) -> Row:
    """Measure a row. The first run is checked and fills the kernel cache; the row holds medians of the others."""
    with tempfile.TemporaryDirectory(prefix="figures-") as folder:
        first, output = compress(SCENES[name], command, Path(folder))
        check_result(first, output)
        runs = [compress(SCENES[name], command, Path(folder))[0] for _ in range(repeats)] or [first]
    check(all(run.file == first.file for run in runs), f"{name}, {command}: not the same bytes in every run")
    record = first.record
    device = record["run"]["device"]
    middle = {
        key: statistics.median(getattr(run, key) for run in runs) for key in ("seconds", "cpu_seconds", "peak_mib")
    }
    values = (
        name,
        command,
        record["size"],
        f"{record['ratio']:.1f}",
        f"{record['quality']['drop']:.3f}",
        f"{record['quality']['fidelity']:.2f}",
        *promise_figures(record),
        f"{middle['seconds']:.1f}",
        f"{middle['cpu_seconds']:.1f}",
        f"{middle['peak_mib']:.0f}",
        f"{device['name'] if device else 'NumPy'}, {os.cpu_count()} cores",
        revision(),
    )
    return dict(zip(COLUMNS, map(str, values)))


def promise_figures(record: dict[str, Any]) -> tuple[str, ...]:
    """Worst view and what it may lose, SSIM lost, FLIP, and what decided, from the record of a run against photos."""
    quality, promise = record["quality"], record["promise"]
    parts = {part["name"]: part for part in promise["parts"]} if promise else {}
    worst = parts.get("worst view")
    return (
        f"{quality['worst']['loss']:.3f}",
        f"{worst['allowed']:.3f}" if worst else "",
        f"{quality['original_ssim'] - quality['ssim']:.4f}",
        f"{quality['flip']:.4f}",
        promise["decided"] if promise else "target",
    )


def read_rows(place: Path = CSV) -> list[Row]:
    """The rows of a CSV file; none if it does not exist."""
    if not place.exists():
        return []
    with open(place, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def put(row: Row, place: Path = CSV) -> None:
    """Add a row, or replace the row of its scene and command. Rows stay in the order of `SCENES` and `COMMANDS`."""
    rows = {(other["scene"], other["command"]): other for other in [*read_rows(place), row]}

    def rank(key: tuple[str, str]) -> tuple[int, int]:
        scenes, commands = list(SCENES), list(COMMANDS)
        return scenes.index(key[0]), commands.index(key[1]) if key[1] in commands else len(commands)

    new = place.with_suffix(".part")
    with open(new, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows[key] for key in sorted(rows, key=rank))
    new.replace(place)


def run(scenes: Sequence[str], commands: Sequence[str], repeats: int) -> None:
    """Measure every command on every scene that exists, and write each row at once."""
    revision()  # before the first row changes the checkout
    for name in scenes:
        if not (SCENES[name] / "point_cloud.ply").is_file():
            print(f"no scene at {SCENES[name]}: skipped (FLEXGS_SCENES names the folder)", file=sys.stderr)
            continue
        for command in commands:
            if name in COMMANDS[command]:
                row = measure(name, command, repeats)
                put(row)
                print(json.dumps(row), flush=True)


# Tables


class Missing(Exception):
    """A table needs a row that the file lacks."""


def figure(rows: Sequence[Row], scene: str, command: str, column: str) -> float:
    """One figure of a row; raises `Missing` without the row."""
    for row in rows:
        if row["scene"] == scene and row["command"] == command:
            return float(row[column])
    raise Missing(f"{CSV.name} has no row for {scene}, {command}: python -m benchmarks.figures run --scene {scene}")


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(line) + " |" for line in [head, *rows]]
    return "\n".join([lines[0], "|" + "---|" * len(head), *lines[1:]])


def megabytes(size: float) -> str:
    """A size in MB (10^6 bytes) with three digits."""
    return f"{size / 1e6:#.3g}" if size < 9.995e6 else f"{size / 1e6:.1f}"


def scenes_table(rows: Sequence[Row]) -> str:
    """Every effort on every scene: size, ratio, processor seconds."""

    def cell(scene: str, command: str) -> str:
        size, ratio, cpu = (figure(rows, scene, command, column) for column in ("bytes", "ratio", "cpu_seconds"))
        return f"{megabytes(size)} MB, {ratio:.1f}x, {cpu:.0f} s"

    return table(
        ("command", *SHOWN), ((f"`{command}`", *(cell(name, command) for name in SHOWN)) for command in EFFORTS)
    )


def promise_table(rows: Sequence[Row]) -> str:
    """Every command on every scene: what it lost by each measure, and which bound decided."""
    head = ("scene", "command", "MB", "ratio", "drop, dB", "worst view (allowed), dB", "SSIM lost", "FLIP", "decided")
    lines = []
    for row in rows:
        if row["command"] in (*EFFORTS, *MEAN) and row["ssim_lost"]:
            allowed = f" ({float(row['worst_allowed_db']):.2f})" if row["worst_allowed_db"] else ""
            lines.append(
                (
                    row["scene"],
                    f"`{row['command']}`",
                    megabytes(float(row["bytes"])),
                    f"{row['ratio']}x",
                    f"{float(row['drop_db']):.2f}",
                    f"{float(row['worst_db']):.2f}{allowed}",
                    row["ssim_lost"],
                    row["flip"],
                    row["decided"],
                )
            )
    return table(head, lines)


def span(values: Iterable[float]) -> str:
    """The smallest and the largest of some factors, in words."""
    some = sorted(values)
    least, most = (f"{value:.2g}" if value < 9.95 else f"{value:.0f}" for value in (some[0], some[-1]))
    return f"{least}x" if least == most else f"{least} to {most}x"


def effort_table(rows: Sequence[Row]) -> str:
    """Each effort compared with the default: factors of processor time and of bytes over all scenes."""

    def factors(command: str, column: str) -> str:
        scenes = [name for name in COMMANDS[command] if name in SHOWN]
        return span(figure(rows, s, command, column) / figure(rows, s, DEFAULT, column) for s in scenes)

    lines = [(name, factors(command, "cpu_seconds"), factors(command, "bytes")) for command, name in EFFORTS.items()]
    return table(("", "processor time", "bytes"), lines)


def capped_table(_: Sequence[Row]) -> str:
    """Runs of `benchmarks.memory`: limits, peaks and scratch files by the number of Gaussians."""

    def per(value: str, unit: float, digits: str = ".0f") -> str:
        return f"{float(value) / unit:{digits}}" if value else NONE

    lines = [
        (
            per(row["gaussians"], 1e6, ".2g"),
            per(row["cap"], 1 << 20),
            per(row["limit"], 1 << 20),
            per(row["anonymous_peak"] or row["resident_peak"], 1 << 20),
            per(row["scratch"], 1e9, ".1f"),
            per(row["processor_seconds"], 1),
            megabytes(float(row["bytes"])),
        )
        for row in sorted(read_rows(MEMORY_CSV), key=lambda row: (int(row["gaussians"]), bool(row["cap"])))
    ]
    units = ("Gaussians, million", "cap, MiB", "limit, MiB", "peak, MiB", "scratch, GB", "processor, s", "file, MB")
    return table(units, lines)


TABLES: dict[str, Callable[[Sequence[Row]], str]] = {
    "scenes": scenes_table,
    "effort": effort_table,
    "promise": promise_table,
    "capped": capped_table,
}
BLOCK = re.compile(r"(<!-- figures: ([^>]*?) -->\n)(.*?)(<!-- end -->)", re.DOTALL)


def pages(root: Path = ROOT) -> list[Path]:
    """The pages that may contain tables."""
    return [root / "README.md", *sorted((root / "docs").rglob("*.md")), root / "deploy" / "README.md"]


def rewritten(text: str, rows: Sequence[Row]) -> str:
    """The text of a page with its tables made again."""

    def block(found: re.Match[str]) -> str:
        begin, name, _, end = found.groups()
        if name not in TABLES:
            raise Missing(f"no table {name!r}; there are {', '.join(TABLES)}")
        return f"{begin}\n{TABLES[name](rows)}\n\n{end}"

    if text.count("<!-- figures:") != len(BLOCK.findall(text)):
        raise Missing("a block lacks its <!-- end -->")
    return BLOCK.sub(block, text)


def stale(root: Path = ROOT) -> list[str]:
    """The changes that `tables` would make, one line for each page."""
    rows, found = read_rows(root / CSV.relative_to(ROOT)), []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        try:
            if rewritten(text, rows) != text:
                found.append(f"{page.relative_to(root)}: its tables are not those of {CSV.name}")
        except Missing as error:
            found.append(f"{page.relative_to(root)}: {error}")
    return found


def write_tables() -> None:
    """Make the tables of all pages again."""
    rows = read_rows()
    for page in pages():
        text = page.read_text(encoding="utf-8")
        new = rewritten(text, rows)
        if new != text:
            page.write_text(new, encoding="utf-8")
            print(f"{page.relative_to(ROOT)}: written")


# The picture of README.md


def picture() -> None:
    """Draw one held-out view of the bundled scene: the original, then compressed by `paper`, then by `best`."""
    name = "still_life"
    with tempfile.TemporaryDirectory(prefix="figures-") as folder:

        def draw(scene: Path) -> Image.Image:
            views = Path(folder) / scene.suffix[1:]
            words = ["render", str(scene), "-o", str(views), "-f", "-q", "--views", VIEW]
            words += ["--cameras", str(SCENES[name] / "cameras.json")]
            subprocess.run(
                [sys.executable, "-m", "flexgs_edge", *words], cwd=ROOT, stdout=subprocess.DEVNULL, check=True
            )
            return Image.open(next(views.glob("*.png"))).convert("RGB")

        original = SCENES[name] / "point_cloud.ply"
        shown = [(f"original PLY: {megabytes(original.stat().st_size)} MB", draw(original))]
        for command, label in (("compress --method paper", "--method paper"), (DEFAULT, "--method best")):
            taken, output = compress(SCENES[name], command, Path(folder))
            check_result(taken, output)
            shown.append((f"{label}: {megabytes(len(taken.file))} MB", draw(output)))
    wide, high = shown[0][1].size
    whole = Image.new("RGB", (wide * len(shown), high + LABEL), "white")
    for k, (words, view) in enumerate(shown):
        whole.paste(view, (k * wide, LABEL))
        ImageDraw.Draw(whole).text((k * wide + 8, 4), words, fill="black", font_size=LABEL - 10)
    whole.save(PICTURE, quality=88)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("run", "tables", "picture"))
    parser.add_argument("--scene", action="append", choices=SCENES, help="default: all that are there")
    parser.add_argument("--command", action="append", choices=COMMANDS, help="default: all")
    parser.add_argument(
        "--repeats", type=int, default=1, help="timed runs after the one that is checked; 0: that one counts"
    )
    parser.add_argument(
        "--check", action="store_true", help="write nothing; fail where a table is not that of the CSV file"
    )
    options = parser.parse_args()
    if options.what == "run":
        run(options.scene or list(SCENES), options.command or list(COMMANDS), options.repeats)
    elif options.what == "picture":
        picture()
    elif options.check:
        if found := stale():
            raise CheckFailed("\n".join([*found, "run: python -m benchmarks.figures tables"]))
    else:
        write_tables()


if __name__ == "__main__":
    main()
