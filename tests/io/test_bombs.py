"""Files that unpack to far more than they take: refused before they are unpacked, where the memory limit has no room."""

from __future__ import annotations

import gzip
import json
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import zstandard

from flexgs_edge.errors import BudgetError, FormatError
from flexgs_edge.io.reading import Reading
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.scene.fields import FIELD
from scene_files import open_scene
from sog_files import coded, entry, meta_of, random_pictures, write_folder, zipped

ROWS = 1 << 20
ROOM = 8 << 20  # Less than any of these scenes takes in memory
WIDTHS = 9, 1, 3, 3, 4  # Bytes of a row in the arrays of a .spz without SH


def spz(place: Path, rows: int = ROWS) -> Path:
    head = struct.pack("<4sIIBBBB", b"NGSP", 3, rows, 0, 12, 0, 0)
    place.write_bytes(gzip.compress(head + bytes(sum(WIDTHS) * rows), 1))
    return place


def spz4(place: Path) -> Path:
    noise = np.random.default_rng(0).bytes(ROWS >> 8)  # a frame may unpack to a thousand times its bytes at most
    frames = [zstandard.ZstdCompressor().compress(noise * (width << 8)) for width in WIDTHS]
    head = struct.pack("<4sIIBBBBI12x", b"NGSP", 4, ROWS, 0, 12, 0, len(frames), 32)
    table = b"".join(struct.pack("<QQ", len(frame), width * ROWS) for frame, width in zip(frames, WIDTHS, strict=True))
    place.write_bytes(head + table + b"".join(frames))
    return place


def sog(place: Path) -> Path:
    flat = coded(np.full((1024, ROWS // 1024, 4), 252, np.uint8))
    place.write_bytes(zipped(meta_of(2, ROWS, 0), {f"{name}.webp": flat for name in random_pictures(1, 0)}))
    return place


def ply(place: Path, order: str, rows: int = 100_000) -> Path:
    """Rows of text, or each with an empty list."""
    names = [name for field in FIELD.values() for name in field.ply_names(0)]
    lists = ["property list uchar uchar of"] if order else []
    kind = "binary_little_endian" if order else "ascii"
    head = [
        "ply",
        f"format {kind} 1.0",
        f"element vertex {rows}",
        *(f"property float {name}" for name in names),
        *lists,
    ]
    row = bytes(4 * len(names) + 1) if order else b" ".join([b"0"] * (len(names) - 1) + [b"1\n"])
    place.write_bytes("\n".join([*head, "end_header", ""]).encode() + row * rows)
    return place


BOMBS: dict[str, Callable[[Path], Path]] = {
    "a.spz": spz,
    "v4.spz": spz4,
    "a.sog": sog,
    "lists.ply": lambda place: ply(place, "<"),
    "text.ply": lambda place: ply(place, ""),
}


@pytest.mark.parametrize("name", BOMBS)
def test_what_has_no_room_is_refused_before_it_is_unpacked(tmp_path: Path, name: str) -> None:
    place = BOMBS[name](tmp_path / name)
    started = time.process_time()
    with pytest.raises(BudgetError, match=f"reading .*{name} needs .* but the memory limit is .*: use --memory-limit"):
        open_scene(place, Reading(budget=MemoryBudget(100 << 20, (100 << 20) - ROOM)))
    assert time.process_time() - started < 2
    assert open_scene(place, Reading(budget=MemoryBudget(1 << 30, 0))).count in (ROWS, 100_000)


def test_scenes_of_a_streamed_one_share_the_room(tmp_path: Path) -> None:
    """One of them fits, all of them do not."""
    leaves = []
    for number in range(8):
        write_folder(tmp_path / f"{number}", 2, 20_000, 0)
        leaves.append({"lods": {"0": entry(number, 0, 20_000)}})
    files = [f"{number}/meta.json" for number in range(8)]
    place = write_top(tmp_path, files, leaves)
    need = 2_000_000
    with pytest.raises(BudgetError, match="reading .*meta.json needs"):
        open_scene(place, Reading(budget=MemoryBudget(need, 0)))
    assert open_scene(tmp_path / "0" / "meta.json", Reading(budget=MemoryBudget(need, 0))).count == 20_000
    assert open_scene(place, Reading(budget=MemoryBudget(1 << 30, 0))).count == 160_000


def test_one_file_by_many_names_is_read_once(tmp_path: Path) -> None:
    """And a row that two names share is in two leaves."""
    write_folder(tmp_path / "a", 2, 2_000, 0)
    names = ["./" * number + "a/meta.json" for number in range(2_000)]
    apart = [{"lods": {"0": entry(number, number, 1)}} for number in range(2_000)]
    started = time.process_time()
    assert open_scene(write_top(tmp_path, names, apart)).count == 2_000
    assert time.process_time() - started < 2
    with pytest.raises(FormatError, match="expected each row in one leaf"):
        open_scene(write_top(tmp_path, names, [{"lods": {"0": entry(number, 0, 9)}} for number in range(2_000)]))


def write_top(folder: Path, files: list[str], leaves: list[dict[str, object]]) -> Path:
    place = folder / "lod-meta.json"
    place.write_text(json.dumps({"lodLevels": 1, "filenames": files, "tree": {"children": leaves}}))
    return place


def test_a_command_ends_before_its_limit(tmp_path: Path) -> None:
    """200 MB in 1 MB, with a process that holds no more than its limit."""
    place, limit = spz(tmp_path / "a.spz", 10 * ROWS), 160 << 20
    code = (
        "from flexgs_edge.cli.app import main\n"
        "try: main()\n"
        "finally: print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    )
    words = ["decompress", str(place), "-o", str(tmp_path / "a.ply"), "--memory-limit", str(limit)]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=120)
    assert done.returncode == 5 and "reading" in done.stderr and "--memory-limit" in done.stderr, done
    assert int(done.stdout) << 10 <= limit
