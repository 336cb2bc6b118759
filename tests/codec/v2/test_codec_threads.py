"""Chunks side by side: the same bytes and values with any number of threads, in order, with room for few."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.threads import in_order, thread_count
from flexgs_edge.errors import FormatError
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.io.ply import write_ply
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.run.decoding import ahead
from flexgs_edge.scene.fields import FIELD
from grid_scenes import make_grid

ROWS, CHUNK = 900, 300


@pytest.fixture(scope="module")
def grid() -> GridScene:
    return make_grid(ROWS, 1)


class Threaded(GridSource):
    """A file on a machine that suits so many threads."""

    def __init__(self, path: Path, threads: int) -> None:
        super().__init__(path)
        self._threads = threads
        self.asked: list[int] = []

    @property
    def threads(self) -> int:
        return self._threads

    @contextmanager
    def whole_in_order(self, threads: int) -> Iterator[None]:
        self.asked.append(threads)
        with super().whole_in_order(threads):
            yield

    def to_ply(self, path: Path) -> bytes:
        """As `decompress` writes it."""
        with ahead(self, MemoryBudget(2**40)):
            write_ply(path, self)
        return path.read_bytes()


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


def test_the_same_file_and_values_with_any_number_of_threads(grid: GridScene, tmp_path: Path) -> None:
    files, plys = set(), set()
    for threads in (1, 2):
        path = tmp_path / f"{threads}.fgs"
        write_grid(path, grid, {}, chunk_rows=CHUNK, encoded=encode_grid(grid, CHUNK, threads=threads))
        files.add(path.read_bytes())
        source = Threaded(path, threads)
        plys.add(source.to_ply(tmp_path / f"{threads}.ply"))
        assert source.asked == [threads]
        back = Threaded(path, threads).grid()
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


def test_a_damaged_chunk_is_named_from_a_thread(grid: GridScene, tmp_path: Path) -> None:
    path = tmp_path / "a.fgs"
    write_grid(path, grid, {}, chunk_rows=CHUNK)
    data = bytearray(path.read_bytes())
    data[-120] ^= 1
    path.write_bytes(data)
    with pytest.raises(FormatError, match="chunk"):
        Threaded(path, 2).to_ply(tmp_path / "a.ply")
    assert not (tmp_path / "a.ply").exists()


def test_no_chunk_is_decoded_ahead_without_room(grid: GridScene, tmp_path: Path) -> None:
    write_grid(tmp_path / "a.fgs", grid, {}, chunk_rows=CHUNK)
    source = Threaded(tmp_path / "a.fgs", 2)
    for limit in (2**20, 2**30):
        with ahead(source, MemoryBudget(limit)):
            pass
    assert source.asked == [1, 2]
