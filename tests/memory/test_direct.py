"""Reading past the kernel's cache: the bytes of the file from any place, and what is said of what the cache holds."""

from __future__ import annotations

import mmap
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.memory.rows import BUFFER_BYTES, DirectFile, is_cached

SIZE = BUFFER_BYTES + 3 * mmap.PAGESIZE + 5


@pytest.fixture
def place(tmp_path: Path) -> Path:
    (tmp_path / "a").write_bytes(np.random.default_rng(0).bytes(SIZE))
    return tmp_path / "a"


def opened(place: Path) -> DirectFile:
    with open(place, "rb") as file:
        direct = DirectFile.of(file)
    if direct is None:
        pytest.skip("this system, or this disk, reads through the cache only")
    return direct


def test_any_part_is_read(place: Path) -> None:
    direct, expected = opened(place), place.read_bytes()
    page = mmap.PAGESIZE
    for start, stop in ((0, SIZE), (1, 2), (page - 1, page + 1), (7, BUFFER_BYTES), (SIZE - 3, SIZE), (page, page)):
        out = bytearray(stop - start)
        direct.read(start, memoryview(out))
        assert out == expected[start:stop]
    with ThreadPoolExecutor(4) as threads:
        outs = [bytearray(100_003) for _ in range(20)]
        for _ in threads.map(direct.read, (50_001 * at for at in range(20)), map(memoryview, outs)):
            pass
    assert all(out == expected[50_001 * at : 50_001 * at + 100_003] for at, out in enumerate(outs))
    direct.close()


def test_the_end_is_an_error(place: Path) -> None:
    direct = opened(place)
    with pytest.raises(EOFError, match=f"byte {SIZE}"):
        direct.read(SIZE - 2, memoryview(bytearray(3)))
    direct.close()


def test_what_is_not_on_a_disk_cannot(tmp_path: Path) -> None:
    read, write = os.pipe()
    os.close(write)
    with open(read, "rb") as file:
        assert DirectFile.of(file) is None


def test_pages_that_were_dropped_are_not_cached(place: Path) -> None:
    direct = opened(place)
    with open(place, "rb") as file, mmap.mmap(file.fileno(), 0, prot=mmap.PROT_READ) as pages:
        address = np.frombuffer(pages, np.uint8).ctypes.data
        os.fsync(file.fileno())
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
        out = bytearray(SIZE)
        direct.read(0, memoryview(out))
        assert not is_cached(address + mmap.PAGESIZE + 9, 5 * mmap.PAGESIZE)
        assert bytes(out) == file.read()
        assert is_cached(address, SIZE) and is_cached(address + 9, 1)
    direct.close()
