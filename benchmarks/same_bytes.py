"""Checks that output keeps its bytes: compares digests of all files that 50 commands write for the bundled scene.

Every command runs in its own process and folder, by the command line alone. benchmarks/same_bytes.json keeps its exit
code, its summary, its errors, and a digest of every file. For JSON it keeps every key, so that a lost key shows. Times,
memory, the size of scratch files and the device are not compared. PNG and WebP are compared by their pixels, gzip and ZIP
by their contents, because a library makes their bytes. White space between elements of a page does not count. `devices`
is left out because it describes the machine, and `study` because it takes too long.

python -m benchmarks.same_bytes --check [--only NAME ...] [--keep DIR]
python -m benchmarks.same_bytes --write [--only NAME ...]
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Iterator, Sequence
from html.parser import HTMLParser
from importlib.metadata import version
from pathlib import Path
from typing import Any

from PIL import Image

# benchmarks.harness has ROOT too, but imports modules of the package. This check must run while those move.
ROOT = Path(__file__).resolve().parents[1]
KEPT = Path(__file__).with_suffix(".json")
LINKS = {"scene": ROOT / "samples" / "still_life", "golden": ROOT / "tests" / "golden"}
"""Links that the commands find beside their folders."""
LIBRARIES = ("numpy", "pyopencl", "pillow")

SCENE = "../scene/point_cloud.ply"
POSES = "--cameras ../scene/cameras.json"
NUMPY = f"{POSES} --images none --holdout 20 --resolution 64 --device numpy"


def compress(words: str, output: str = "out.fgs", scene: str = SCENE, views: str = "--resolution 240") -> str:
    return f"compress {scene} -o {output} --json out.json -q {views} {words}"


COMMANDS = {
    "fast": compress("--effort fast --report page"),
    "balanced": compress("", views=""),
    "size": compress("--effort fast --max-size 40kB"),
    "ratio": compress("--effort fast --min-ratio 250 --no-refit"),
    "fidelity": compress("--effort fast --min-fidelity 36 --select train --background white"),
    "blind": compress("--effort fast --images none --unseen drop --views-margin --max-worst-drop 2"),
    "auto": compress("--effort fast --cameras auto --antialiased", views="--resolution 128"),
    "scratch": compress("--effort fast --memory-limit 220MiB"),
    "layers": compress("--effort fast --layers 4 --promise mean"),
    "preview": compress("--effort fast --preview 6kB"),
    "preview-scratch": compress("--effort fast --preview 6kB --memory-limit 220MiB"),
    "spz": compress("--effort fast", "out.spz"),
    "sog": compress("--effort fast", "out.sog"),
    "compressed": compress("--effort fast", "out.compressed.ply"),
    "paper-fast": compress("--method paper --effort fast --score-cache cache.npz"),
    "paper-balanced": compress("--method paper --score-cache ../paper-fast/cache.npz"),
    "paper-half": compress("--method paper --score-cache ../paper-fast/cache.npz --max-drop 0.5"),
    "paper-max-size": compress("--method paper --effort fast --max-size 300kB --score meson"),
    "paper-rates": compress("--method paper --prune-rate 0.3 --sh-rate 0.4 --bits rest=3,dc=7 --groups 50"),
    "refuses-paper-spz": compress("--method paper --effort fast", "out.spz"),
    "trim": "trim ../layers/out.fgs -o out.fgs --max-size 12kB --json out.json",
    "few": "decompress ../trim/out.fgs -o out.ply --json out.json -q",
    "numpy": compress("--effort fast --max-drop 6", scene="../few/out.ply", views=NUMPY),
    "numpy-paper": compress("--method paper --effort fast --max-drop 6", scene="../few/out.ply", views=NUMPY),
    "numpy-render": f"render ../few/out.ply -o views --json out.json {POSES} --resolution 64 --views 0 --device numpy",
    "ply": "decompress ../fast/out.fgs -o out.ply --json out.json",
    "ply-of-paper": "decompress ../paper-fast/out.fgs -o out.ply --json out.json",
    "ply-of-trimmed": "decompress ../trim/out.fgs -o out.ply",
    "ply-of-golden": "decompress ../golden/v2/tiny.fgs -o out.ply",
    "ply-of-golden-1": "decompress ../golden/v1/tiny.fgs -o out.ply",
    "to-spz": "decompress ../fast/out.fgs -o out.spz --json out.json",
    "to-sog": "decompress ../fast/out.fgs -o out.sog --json out.json",
    "to-compressed": "decompress ../fast/out.fgs -o out.compressed.ply --json out.json",
    "from-sog": "decompress ../sog/out.sog -o out.ply --json out.json",
    "render": f"render ../fast/out.fgs -o views {POSES} --views 0:80:20 --json out.json -q",
    "evaluate": f"evaluate ../fast/out.fgs --against {SCENE} --resolution 240 --report page --json out.json -q",
    "info": "info ../fast/out.fgs --json out.json",
    "info-paper": "info ../paper-fast/out.fgs --json out.json",
    "info-layers": "info ../layers/out.fgs --json -",
    "info-trimmed": "info ../trim/out.fgs --json out.json",
    "info-ply": f"info {SCENE} --json out.json",
    "info-spz": "info ../spz/out.spz --json out.json",
    "verify": "verify ../fast/out.fgs --json out.json",
    "verify-paper": "verify ../paper-fast/out.fgs --json out.json",
    "refuses-no-scene": "compress nothing.ply -o out.fgs",
    "refuses-no-fgs": f"verify {SCENE}",
    "refuses-options": compress("--method paper --layers 4"),
    "refuses-target": compress("--effort fast --max-size 1kB"),
    "refuses-memory": compress("--effort fast --memory-limit 20MiB"),
}
"""Arguments of `flexgs-edge` by name. `../NAME/` is the folder of the command of that name."""

MASKED = {
    "device",
    "memory_limit",
    "peak_anonymous",
    "peak_memory",
    "scratch",
    "seconds",
    "stages",
    "ms_per_view",
    "view_ms",
}
MASKED |= {"startup_ms", "compile_ms", "warm_up_ms"}
"""Keys of JSON whose values differ from run to run, at any depth. Only the keys below them, and null, are compared."""
MASKS = (
    (re.compile(r"(?m)^(took|memory|device): .*$"), r"\1: *"),
    (re.compile(r"(<dt>device</dt>\s*<dd>)[^<]*"), r"\1*"),
    (re.compile(r'(<span style="width:)[\d.]+(%"></span></td>\s*<td>[\d.]+ s<)'), r"\1*\2"),
    (re.compile(r"\b\d[\d.]*( ?)(ms|s|KiB|MiB|GiB)\b"), r"*\1\2"),
)
"""Patterns of text in summaries and pages that differ from run to run."""


def sha(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()


def masked(text: str) -> str:
    """Text with everything masked that differs from run to run."""
    for pattern, put in MASKS:
        text = pattern.sub(put, text)
    return text


def leaves(value: Any, path: str = "") -> Iterator[tuple[str, Any]]:
    """Every value of a JSON document with its path. Items of a list share a path."""
    if isinstance(value, dict) and value:
        for key, below in value.items():
            where = f"{path}.{key}" if path else key
            if key in MASKED:
                yield (
                    where,
                    f"* {' '.join(sorted(below))}" if isinstance(below, dict) else "*" if below is not None else None,
                )
            else:
                yield from leaves(below, where)
    elif isinstance(value, list) and value:
        for below in value:
            yield from leaves(below, f"{path}[]")
    else:
        yield path, value


def keys_of(document: Any) -> dict[str, Any]:
    """A document's keys, each with its value, or with a digest of all its values in their order."""
    found: dict[str, list[Any]] = {}
    for path, value in leaves(document):
        found.setdefault(path, []).append(value)
    return {
        path: values[0] if len(values) == 1 else f"{len(values)} values {sha(json.dumps(values).encode())[:16]}"
        for path, values in found.items()
    }


class Page(HTMLParser):
    """Collects the elements and texts of a page, without white space between them."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.parts: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.parts.append(json.dumps([tag, sorted(attrs, key=str)]))

    def handle_endtag(self, tag: str) -> None:
        self.parts.append(f"/{tag}")

    def handle_data(self, data: str) -> None:
        self.parts += [" ".join(data.split())] if data.strip() else []


def digest(name: str, data: bytes) -> str:
    """A digest of a file's contents that does not depend on the library that packed it."""
    if name.endswith((".png", ".webp")):
        with Image.open(io.BytesIO(data)) as image:
            return f"{image.mode} {image.width}x{image.height} {sha(image.tobytes())}"
    if data[:2] == b"PK":
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            parts = [f"{part} {digest(part, archive.read(part))}" for part in archive.namelist()]
        return f"{len(parts)} parts {sha(chr(10).join(parts).encode())}"
    if data[:2] == b"\x1f\x8b":
        return f"unpacked {sha(gzip.decompress(data))}"
    if name.endswith(".html"):
        page = Page(masked(data.decode()))
        return f"{len(page.parts)} elements and texts {sha(chr(10).join(page.parts).encode())}"
    return f"{len(data)} bytes {sha(data)}"


def run(name: str, folder: Path) -> dict[str, Any]:
    """Run a command in its folder; returns a record of everything that it wrote."""
    place = folder / name
    place.mkdir()
    words = shlex.split(COMMANDS[name])
    search = os.pathsep.join(filter(None, [str(ROOT), os.environ.get("PYTHONPATH")]))
    done = subprocess.run(
        [sys.executable, "-m", "flexgs_edge", *words],
        cwd=place,
        env={**os.environ, "PYTHONPATH": search, "COLUMNS": "100"},
        capture_output=True,
        text=True,
        check=False,
    )
    found: dict[str, Any] = {"words": COMMANDS[name], "exit code": done.returncode}
    stdout, stderr = (text.replace(str(folder), "..") for text in (done.stdout, done.stderr))
    if words[-2:] == ["--json", "-"]:
        found["stdout"] = keys_of(json.loads(stdout))
    else:
        found["stdout"] = masked(stdout).splitlines()
    found["stderr"] = masked(stderr).splitlines()
    for path in sorted(p for p in place.rglob("*") if p.is_file()):
        data, label = path.read_bytes(), path.relative_to(place).as_posix()
        if path.suffix in {".json", ".html"}:
            data = data.replace(str(folder).encode(), b"..")
        found[label] = keys_of(json.loads(data)) if path.suffix == ".json" else digest(path.name, data)
    return found


def differences(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Sentences about differences, by file, key or line."""
    found = []
    for item in {**before, **now}:
        old, new = before.get(item), now.get(item)
        if old == new:
            continue
        if isinstance(old, list) and isinstance(new, list):
            old, new = ({f"line {k + 1}": line for k, line in enumerate(lines)} for lines in (old, new))
        if isinstance(old, dict) and isinstance(new, dict):
            for key in {**old, **new}:
                if old.get(key) != new.get(key):
                    found.append(f"{item}: {key}: was {old.get(key, 'missing')}, is {new.get(key, 'missing')}")
        elif old is None or new is None:
            found.append(f"{item}: {'new' if old is None else 'missing'}")
        else:
            found.append(f"{item}: was {old}, is {new}")
    return found


def needed(names: Sequence[str]) -> set[str]:
    """These commands, and all commands whose files they read."""
    found: set[str] = set()
    left = list(names)
    while left:
        name = left.pop()
        if name not in found:
            found.add(name)
            left += [other for other in re.findall(r"\.\./([\w-]+)/", COMMANDS[name]) if other in COMMANDS]
    return found


def in_order(names: set[str]) -> list[str]:
    """The commands in the order of the table, each after those whose files it reads."""
    done: list[str] = []
    while len(done) < len(names):
        done += [name for name in COMMANDS if name in names - set(done) and needed([name]) - {name} <= set(done)]
    return done


def machine() -> dict[str, str]:
    """The device and libraries of this machine, on which digests depend."""
    done = subprocess.run(
        [sys.executable, "-m", "flexgs_edge", "devices"], cwd=ROOT, capture_output=True, text=True, check=False
    )
    first = done.stdout.splitlines()[:1]
    return {"device": first[0] if first else "none", **{name: version(name) for name in LIBRARIES}}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    what = parser.add_mutually_exclusive_group(required=True)
    what.add_argument("--check", action="store_true", help="compare with what is kept; 1 where something differs")
    what.add_argument("--write", action="store_true", help="keep what is written now")
    parser.add_argument("--only", nargs="+", choices=COMMANDS, metavar="NAME", help="these, and those that they read")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="a new folder for all files, to compare two states' files"
    )
    options = parser.parse_args()
    kept = json.loads(KEPT.read_text(encoding="utf-8")) if KEPT.is_file() else {"machine": {}, "commands": {}}
    here, start, wrong = machine(), time.perf_counter(), 0
    if options.check and here != kept["machine"]:
        print(f"note: kept on {kept['machine']}, now on {here}", flush=True)
    found: dict[str, Any] = {}
    with tempfile.TemporaryDirectory(prefix="same-bytes-") as name:
        folder = options.keep.resolve() if options.keep else Path(name).resolve()
        folder.mkdir(parents=True, exist_ok=not options.keep)
        for link, to in LINKS.items():
            (folder / link).symlink_to(to, target_is_directory=True)
        for command in in_order(needed(options.only or list(COMMANDS))):
            begun = time.perf_counter()
            found[command] = run(command, folder)
            seconds = f"{time.perf_counter() - begun:.1f} s"
            if options.write:
                print(f"{command}: exit code {found[command]['exit code']}, {seconds}", flush=True)
                continue
            lines = differences(kept["commands"].get(command, {}), found[command])
            wrong += bool(lines)
            print(f"{command}: {'DIFFERENT: ' + '; '.join(lines) if lines else 'equal'}, {seconds}", flush=True)
    if options.write:
        merged = {**kept["commands"], **{name: found[name] for name in options.only or COMMANDS}}
        record = {"machine": here, "commands": {name: merged[name] for name in COMMANDS if name in merged}}
        KEPT.write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    print(f"{len(found)} commands, {wrong} different, {time.perf_counter() - start:.0f} s")
    raise SystemExit(1 if wrong else 0)


if __name__ == "__main__":
    main()
