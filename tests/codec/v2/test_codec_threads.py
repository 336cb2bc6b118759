"""Chunks side by side: the same bytes and values with any number of threads, in order, with room for few."""

from __future__ import annotations

import threading
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.threads import in_order, thread_count
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import FormatError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.run.decoding import ahead
from flexgs_edge.scene.fields import FIELD
from grid_scenes import make_grid

ROWS, CHUNK = 900, 300


@pytest.fixture(scope="module")
def grid() -> GridScene:
    return make_grid(ROWS, 1)


def use_threads(monkeypatch: pytest.MonkeyPatch, threads: int) -> None:
    for module in ("encode", "grid_source"):
        monkeypatch.setattr(f"flexgs_edge.codec.v2.{module}.thread_count", lambda chunks: min(threads, chunks))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order_and_not_far_ahead(threads: int) -> None:
    running, most, seen = set(), 0, []
    lock = threading.Lock()

    def work(item: int) -> int:
        nonlocal most
        with lock:
            running.add(item)
            most = max(most, len(running))
        return item * item

    for result in in_order(work, range(40), threads):
        seen.append(result)
        with lock:
            # What waits is finished or in work; the one that is read is not counted.
            running.discard(int(result**0.5))
    assert seen == [i * i for i in range(40)]
    assert most <= threads + 1


def test_an_error_arrives_and_ends_the_work() -> None:
    started = []

    def work(item: int) -> int:
        started.append(item)
        if item == 3:
            raise ValueError("three")
        return item

    with pytest.raises(ValueError, match="three"):
        list(in_order(work, range(1000), 2))
    assert len(started) < 20


def test_as_many_threads_as_chunks_at_most() -> None:
    assert thread_count(0) == thread_count(1) == 1 and 1 <= thread_count(10**6) <= 2


def test_the_same_file_and_values_with_any_number_of_threads(
    grid: GridScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, plys = set(), set()
    for threads in (1, 2):
        use_threads(monkeypatch, threads)
        write_grid(tmp_path / f"{threads}.fgs", grid, {}, chunk_rows=CHUNK)
        files.add((tmp_path / f"{threads}.fgs").read_bytes())
        decompress(tmp_path / f"{threads}.fgs", tmp_path / f"{threads}.ply")
        plys.add((tmp_path / f"{threads}.ply").read_bytes())
        back = GridSource(tmp_path / f"{threads}.fgs").grid()
        np.testing.assert_array_equal(back.position, grid.position)
        np.testing.assert_array_equal(back.sh[0], grid.sh[0])
    assert len(files) == len(plys) == 1


def test_chunks_out_of_order_while_they_come_in_order(grid: GridScene, tmp_path: Path) -> None:
    write_grid(tmp_path / "a.fgs", grid, {}, chunk_rows=CHUNK)
    fields = list(FIELD)
    expected = GridSource(tmp_path / "a.fgs").read(slice(0, ROWS), fields)
    source = GridSource(tmp_path / "a.fgs")
    with source.whole_in_order(2):
        for rows in (slice(0, 450), slice(450, 650), slice(100, 200), slice(650, ROWS)):
            for name, values in source.read(rows, fields).items():
                np.testing.assert_array_equal(values, expected[name][:, rows])


def test_a_damaged_chunk_is_named_from_a_thread(
    grid: GridScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.fgs"
    write_grid(path, grid, {}, chunk_rows=CHUNK)
    data = bytearray(path.read_bytes())
    data[-120] ^= 1
    path.write_bytes(data)
    use_threads(monkeypatch, 2)
    with pytest.raises(FormatError, match="chunk"):
        decompress(path, tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


def test_no_chunk_is_decoded_ahead_without_room(
    grid: GridScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_grid(tmp_path / "a.fgs", grid, {}, chunk_rows=CHUNK)
    use_threads(monkeypatch, 2)
    asked = []
    monkeypatch.setattr(GridSource, "whole_in_order", lambda self, threads: nullcontext(asked.append(threads)))
    for limit in (2**20, 2**30):
        with ahead(GridSource(tmp_path / "a.fgs"), MemoryBudget(limit)):
            pass
    assert asked == [1, 2]
