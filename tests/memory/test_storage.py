"""Arrays in memory and in scratch files: the same values, room given back, and errors before anything breaks."""

from __future__ import annotations

import errno
import gc
import mmap
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.memory import rows as memory_rows
from flexgs_edge.memory import storage as storage_module
from flexgs_edge.memory.rows import copy_rows, put_rows, read_rows
from flexgs_edge.memory.storage import IN_MEMORY, ScratchStorage, Storage, file_system_of, stable_order
from flexgs_edge.methods.best.checkpoint import Checkpoint
from flexgs_edge.methods.best.costs import lowest

COUNT = 40_000


@pytest.fixture(params=["memory", "files"])
def storage(request: pytest.FixtureRequest, tmp_path: Path) -> Storage:
    return IN_MEMORY if request.param == "memory" else ScratchStorage(tmp_path)


def test_take_and_copy(storage: Storage) -> None:
    rng = np.random.default_rng(1)
    rows = np.sort(rng.choice(COUNT, 30_000, replace=False))
    for values in (rng.normal(size=COUNT), rng.normal(size=(3, 4, COUNT)), rng.normal(size=(2, COUNT))):
        np.testing.assert_array_equal(storage.take(values, rows), values[..., rows])
        copied = storage.copy(values[..., ::2])
        np.testing.assert_array_equal(copied, values[..., ::2])
        assert copied.flags.c_contiguous and copied.flags.writeable
    assert storage.take(np.zeros((0, COUNT)), rows).shape == (0, len(rows))
    assert storage.empty((3, 0), np.float32).shape == (3, 0)


@pytest.mark.parametrize("shape", [(COUNT,), (3, COUNT), (2, 4, COUNT)])
def test_copied_rows_are_those_of_the_array(storage: Storage, shape: tuple[int, ...]) -> None:
    """Of a whole array and of some of its planes, into planes that are not next to each other, and into every second element."""
    held = storage.copy(np.random.default_rng(2).normal(size=shape).astype(np.float32))
    held[..., 7] = 5  # not on the disk yet
    for values in (held, held[1:]) if held.ndim > 1 else (held,):
        for start, stop in ((0, COUNT), (5, 4097), (COUNT - 1, COUNT), (9, 9)):
            wide = np.full((*values.shape[:-1], 3 * COUNT), -1, np.float32)
            for out in (wide[..., : stop - start], wide[..., COUNT : COUNT + 2 * (stop - start) : 2]):
                copy_rows(values, slice(start, stop), out)
                np.testing.assert_array_equal(out, values[..., start:stop])
            assert (wide[..., stop - start : COUNT] == -1).all() and (wide[..., COUNT + 1 :: 2] == -1).all()


@pytest.mark.parametrize("cached", [True, False])
@pytest.mark.parametrize("shape", [(COUNT,), (3, COUNT), (2, 4, COUNT)])
def test_rows_that_are_put_are_read(
    storage: Storage, shape: tuple[int, ...], cached: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether they are in the kernel's cache or not, by the accessors and through the pages."""
    monkeypatch.setattr(memory_rows, "is_cached", lambda address, size: cached)
    expected = np.random.default_rng(3).normal(size=shape).astype(np.float32)
    held = storage.copy(expected)
    for start, stop in ((0, COUNT), (5, 4097), (COUNT - 1, COUNT), (9, 9)):
        rows = slice(start, stop)
        np.testing.assert_array_equal(read_rows(held, rows), expected[..., rows])
        part = np.arange(np.prod(expected[..., rows].shape)).reshape(expected[..., rows].shape)
        for values in (part, 5):
            put_rows(held, rows, values)  # of another type, or one for all
            expected[..., rows] = values
            np.testing.assert_array_equal(read_rows(held, rows), expected[..., rows])
            np.testing.assert_array_equal(held, expected)
    if held.ndim > 1:
        np.testing.assert_array_equal(read_rows(held[1:], slice(3, 8)), expected[1:, ..., 3:8])
        put_rows(held[1:], slice(3, 8), 7)
        expected[1:, ..., 3:8] = 7
        np.testing.assert_array_equal(held, expected)


@pytest.fixture
def fetched(monkeypatch: pytest.MonkeyPatch) -> list[slice]:
    """Rows that were looked up through the pages."""
    found: list[slice] = []
    monkeypatch.setattr(memory_rows, "fetch", lambda plane, rows: found.append(rows))
    return found


def test_rows_in_any_order_are_taken(storage: Storage, tmp_path: Path, fetched: list[slice]) -> None:
    """From a plane that is read as a whole, where memory holds it; else rows far apart are looked up through the pages."""
    spills = storage.spills
    for whole in (storage_module.WHOLE_BYTES, 0):
        storage = ScratchStorage(tmp_path, whole=whole) if spills else Storage()
        storage.whole_bytes = whole
        values = storage.copy(np.random.default_rng(4).normal(size=(3, COUNT)))
        for rows, apart in (
            (np.arange(0, COUNT, 2), False),
            (np.array([5, COUNT - 1, 7]), True),
            (np.arange(0), False),
        ):
            fetched.clear()
            np.testing.assert_array_equal(storage.take(values, rows), values[:, rows])
            assert bool(fetched) is (apart and storage.spills and not whole)
            np.testing.assert_array_equal(memory_rows.read_listed(values, rows), values[:, rows])


def test_larger_planes_are_held_where_the_limit_is_large(tmp_path: Path, fetched: list[slice]) -> None:
    storage = ScratchStorage(tmp_path, 16 * 8 * COUNT, whole=0)
    values, rows = storage.copy(np.random.default_rng(5).normal(size=(2, COUNT))), np.array([5, COUNT - 1, 7])
    np.testing.assert_array_equal(storage.take(values, rows), values[:, rows])
    assert not fetched


def test_a_part_is_fetched_plane_by_plane(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    advise = memory_rows.MappedFile.madvise

    def note(self: memory_rows.MappedFile, *words: int) -> None:
        asked.append(words)
        advise(self, *words)

    values = ScratchStorage(tmp_path).empty((3, 4, 10_000), np.float32)
    numbers = values.reshape(-1)
    numbers[:] = np.arange(numbers.size)
    monkeypatch.setattr(memory_rows.MappedFile, "madvise", note)
    for view in (values, values[1:, ::2, 5:], values.reshape(12, -1)[3:5], numbers):
        asked.clear()
        memory_rows.fetch(view, slice(2_100, 5_000))
        pieces = [numbers[start // 4 : (start + length) // 4] for _, start, length in asked]
        got = set(np.concatenate(pieces).astype(int).tolist())
        part = view[..., 2_100:5_000]
        assert got >= set(part.reshape(-1).astype(int).tolist())
        assert len(got) <= part.size + len(pieces) * mmap.PAGESIZE // 4
    asked.clear()
    memory_rows.fetch(np.zeros((3, 4)), slice(0, 4))
    memory_rows.fetch(values[:, :0], slice(0, 4))
    assert not asked


def test_files_are_gone_with_their_arrays(tmp_path: Path) -> None:
    storage = ScratchStorage(tmp_path)
    first, second = storage.empty((1 << 17,), np.uint8), storage.empty((1 << 18,), np.float64)
    part = second[100:]
    assert storage.used == storage.peak == 17 << 17 and not list(tmp_path.iterdir())
    first[:] = 7
    del first, second
    gc.collect()
    assert storage.used == 1 << 21, "a view keeps its file"
    del part
    gc.collect()
    assert storage.used == 0 and storage.peak == 17 << 17
    storage.close()


def test_small_arrays_stay_in_memory(tmp_path: Path) -> None:
    storage = ScratchStorage(tmp_path)
    storage.empty((100,), np.float64)
    assert storage.peak == 0


def test_a_kill_leaves_nothing(tmp_path: Path) -> None:
    code = (
        "import os, signal, sys\nfrom flexgs_edge.memory.storage import ScratchStorage\nstorage = ScratchStorage(sys.argv[1])\n"
        "values = storage.empty((1 << 20,), 'f8'); values[:] = 1\n"
        "file = storage.file(); file.write(bytes(1 << 20)); file.flush()\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert done.returncode == -9 and not list(tmp_path.iterdir())


def refuse_blocks(monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    """No file gets blocks any more."""

    def refused(descriptor: int, offset: int, size: int) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(os, "posix_fallocate", refused)


def test_a_full_disk_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = ScratchStorage(tmp_path)
    held = storage.empty((1 << 20,), np.uint8)
    refuse_blocks(monkeypatch, errno.ENOSPC)
    with pytest.raises(
        BudgetError, match=r"disk is full: scratch files hold 1\.05 MB there, 2\.10 MB more .*--scratch"
    ):
        storage.empty((1 << 21,), np.uint8)
    assert storage.used == len(held) and not list(tmp_path.iterdir())


def test_other_failures_are_errors_of_input(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    storage = ScratchStorage(tmp_path)
    refuse_blocks(monkeypatch, errno.EIO)
    with pytest.raises(InputError, match="cannot make a scratch file of 2097152 bytes"):
        storage.empty((1 << 21,), np.uint8)


def test_no_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no scratch file can be made there"):
        ScratchStorage(tmp_path / "nothing")


def test_a_folder_in_memory_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(storage_module, "file_system_of", lambda folder: "tmpfs")
    with pytest.raises(InputError, match="which lies in memory"):
        ScratchStorage(tmp_path)


def test_kinds_of_file_systems(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    mounts.write_text(
        "/dev/a / ext4 rw 0 0\ntmpfs /tmp tmpfs rw 0 0\n/dev/b /tmp/big\\040disk xfs rw 0 0\n/dev/c /data ext4 rw 0 0\n"
        "ramfs /data ramfs rw 0 0\n"
    )
    found = [
        file_system_of(Path(place), mounts) for place in ("/home/x", "/tmp/x", "/tmpx", "/tmp/big disk/x", "/data")
    ]
    assert found == ["ext4", "tmpfs", "ext4", "xfs", "ramfs"]
    assert file_system_of(Path("/tmp"), tmp_path / "nothing") is None
    assert file_system_of(Path("/dev/shm")) in ("tmpfs", None)


@pytest.mark.parametrize("values", [1, 7, 1000, 1 << 40])
def test_orders_in_parts_are_stable(tmp_path: Path, values: int) -> None:
    keys = np.random.default_rng(values).integers(0, values, COUNT).astype(np.uint64)
    expected = np.argsort(keys, kind="stable")
    np.testing.assert_array_equal(stable_order(keys, ScratchStorage(tmp_path), rows=1000), expected)
    np.testing.assert_array_equal(stable_order(keys), expected)


@pytest.mark.parametrize("values", [2, 50, 1 << 40])
def test_the_lowest_are_those_that_a_stable_sort_puts_first(values: int) -> None:
    costs = np.random.default_rng(values).integers(0, values, 3000).astype(np.float64)
    costs[::7] = np.inf
    for count in (-1, 0, 1, 2, 1500, 2999, 3000, 4000):
        expected = np.zeros(3000, bool)
        expected[np.argsort(costs, kind="stable")[: max(count, 0)]] = True
        np.testing.assert_array_equal(lowest(costs, count), expected)


def test_checkpoints(storage: Storage, tmp_path: Path) -> None:
    checkpoint = Checkpoint(tmp_path / "kept")
    arrays = {"a": np.arange(12.0).reshape(2, 2, 3), "b": np.arange(5), "c": np.zeros((0, 7), np.float32)}
    assert checkpoint.rounds == 0
    for number in range(2):
        checkpoint.save(number, arrays.items())
    (checkpoint.folder / "round-1" / "done").unlink()
    again = Checkpoint(tmp_path / "kept")
    assert again.rounds == 1 and not again.has(1)
    for name, values in again.load(0, storage).items():
        np.testing.assert_array_equal(values, arrays[name])
        assert values.dtype == arrays[name].dtype and values.shape == arrays[name].shape
    again.remove()
    assert not (tmp_path / "kept").exists()
    with pytest.raises(InputError, match="cannot keep the state"):
        Checkpoint(tmp_path / "no" / "folder")
