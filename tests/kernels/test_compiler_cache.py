"""PoCL's folder of compiled kernels: another one where it cannot be written, and no damaged files in it."""

from __future__ import annotations

import logging
import os
import struct
from pathlib import Path

import pytest

from flexgs_edge.kernels.choose_device import ELF, STAMP, VARIABLE, compiler_cache, prepare_compiler_cache

LIBRARY = (ELF.ljust(40, b"\0") + struct.pack("<Q", 64) + bytes(10) + struct.pack("<HH", 64, 2) + bytes(2)).ljust(
    192, b"\0"
)
PROGRAM = b"BC\xc0\xde" + struct.pack("<II", 0x35, 2) + bytes(8) + struct.pack("<II", 0xC14, 1) + bytes(4)


def entry(folder: Path, name: str, library: bytes = LIBRARY, program: bytes = PROGRAM) -> Path:
    place = folder / name[:2] / name[2:]
    (place / "blend" / "64-1-1").mkdir(parents=True)
    (place / "blend" / "64-1-1" / "blend.so").write_bytes(library)
    (place / "program.bc").write_bytes(program)
    return place


@pytest.fixture(autouse=True)
def anew(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    prepare_compiler_cache.cache_clear()


def test_damaged_entries_go_and_whole_ones_stay(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    whole = [entry(tmp_path, "AAwhole"), entry(tmp_path, "ABother", b"\x7fELF of another kind", b"no bitcode")]
    broken = [
        entry(tmp_path, "ACempty", library=b""), entry(tmp_path, "AAcut", library=LIBRARY[:-1]),
        entry(tmp_path, "ADshort", program=PROGRAM[:-1]), entry(tmp_path, "AEhead", program=PROGRAM[:22]),
        entry(tmp_path, "AFnone", program=b""),
    ]  # fmt: skip
    prepare_compiler_cache()
    assert all(place.exists() for place in whole) and not any(place.exists() for place in broken)
    assert "5 damaged entries were removed" in caplog.text


def test_files_of_an_earlier_check_are_not_opened_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, str(tmp_path))
    old, new = entry(tmp_path, "AAold", library=b""), entry(tmp_path, "ABnew", library=b"")
    (tmp_path / STAMP).touch()
    for file in (old / "blend/64-1-1/blend.so", old / "program.bc"):
        os.utime(file, (1.0, 1.0))
    prepare_compiler_cache()
    assert old.exists() and not new.exists()


@pytest.mark.parametrize("variable", ["HOME", "XDG_CACHE_HOME"])
def test_another_folder_where_the_usual_one_cannot_be_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, variable: str
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.delenv("XDG_CACHE_HOME", raising=False)
    monkeypatch.setenv(variable, str(tmp_path / "file"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setenv(VARIABLE, "")  # is put back after the test
    usual = compiler_cache()
    prepare_compiler_cache()
    assert os.environ[VARIABLE] == str(tmp_path / f"flexgs-edge-{os.getuid()}") and compiler_cache().is_dir()
    assert f"{usual} cannot be written" in caplog.text and "compiled kernels are kept in" in caplog.text


def test_a_folder_of_somebody_else_is_not_trusted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    (tmp_path / f"flexgs-edge-{os.getuid()}").mkdir(mode=0o777)
    (tmp_path / f"flexgs-edge-{os.getuid()}").chmod(0o777)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    monkeypatch.setattr("flexgs_edge.kernels.choose_device.SHARED_MEMORY", str(tmp_path / "file"))
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file" / "kcache"))
    with caplog.at_level(logging.WARNING):
        prepare_compiler_cache()
    assert os.environ[VARIABLE] == str(tmp_path / "file" / "kcache") and f"or one in {VARIABLE}" in caplog.text
