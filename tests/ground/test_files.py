"""Files are written whole or not at all."""

from __future__ import annotations

import errno
import os
import resource
from pathlib import Path

import pytest

from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.files import atomic_folder, atomic_write, check_writable


def test_the_file_appears_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "a.bin"
    with atomic_write(target) as file:
        file.write(b"12")
        assert not target.exists()
        file.seek(0)
        assert file.read() == b"12"
    assert target.read_bytes() == b"12"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_permissions_are_those_of_a_plain_file(tmp_path: Path) -> None:
    (tmp_path / "plain").touch()
    with atomic_write(tmp_path / "a.bin"):
        pass
    assert (tmp_path / "a.bin").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("error", [ValueError("x"), KeyboardInterrupt(), OSError(errno.EIO, "io")])
def test_an_error_leaves_the_earlier_file_and_nothing_else(tmp_path: Path, error: BaseException) -> None:
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(type(error)), atomic_write(target, force=True) as file:
        file.write(b"new")
        raise error
    assert target.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.bin"]


def test_no_overwrite_without_force(tmp_path: Path) -> None:
    target = tmp_path / "a.bin"
    target.write_bytes(b"old")
    with pytest.raises(InputError, match=r"a\.bin: the file exists.*-f"), atomic_write(target):
        pytest.fail("the block must not run")
    with atomic_write(target, force=True) as file:
        file.write(b"new")
    assert target.read_bytes() == b"new"


def test_a_link_is_followed(tmp_path: Path) -> None:
    (tmp_path / "real").mkdir()
    link = tmp_path / "link.bin"
    link.symlink_to(tmp_path / "real" / "a.bin")
    with atomic_write(link) as file:
        file.write(b"x")
    assert link.is_symlink() and (tmp_path / "real" / "a.bin").read_bytes() == b"x"


@pytest.mark.parametrize(
    ("name", "words"),
    [("none/a.bin", "does not exist"), ("folder", "a folder or a special file"), ("pipe", "a special file")],
)
def test_places_that_cannot_be_written(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match=words):
        check_writable(tmp_path / name, force=True)


def test_a_full_disk_is_a_budget_error(tmp_path: Path) -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, hard))
    try:
        with pytest.raises(BudgetError, match=r"a\.bin: the disk is full"), atomic_write(tmp_path / "a.bin") as file:
            for _ in range(30):
                file.write(bytes(10_000))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []


def test_a_full_disk_by_its_own_code(tmp_path: Path) -> None:
    with pytest.raises(BudgetError, match="the disk is full"), atomic_write(tmp_path / "a.bin"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(InputError, match="cannot write there"), atomic_write(tmp_path / "a.bin"):
            pytest.fail("the block must not run")
    finally:
        tmp_path.chmod(0o700)


def test_a_name_as_long_as_the_file_system_allows(tmp_path: Path) -> None:
    target = tmp_path / ("n" * 255)
    with atomic_write(target) as file:
        file.write(b"x")
    assert target.exists()
    with pytest.raises(InputError, match="cannot write there"), atomic_write(tmp_path / ("n" * 256)):
        pass


def test_a_folder_that_is_empty_needs_no_force(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    with atomic_folder(tmp_path / "out") as place:
        (place / "a.csv").write_text("a")
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["a.csv"]


def test_a_forced_folder_keeps_files_of_other_names(tmp_path: Path) -> None:
    out = tmp_path / "out"
    (out / "fox").mkdir(parents=True)
    (out / "fox" / "a.csv").write_text("old")
    (out / "notes.txt").write_text("mine")
    with atomic_folder(out, force=True) as place:
        (place / "fox").mkdir()
        (place / "fox" / "a.csv").write_text("new")
        (place / "index.html").write_text("page")
        assert (out / "fox" / "a.csv").read_text() == "old"
    assert (out / "fox" / "a.csv").read_text() == "new" and (out / "notes.txt").read_text() == "mine"
    assert sorted(path.name for path in out.iterdir()) == ["fox", "index.html", "notes.txt"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]
