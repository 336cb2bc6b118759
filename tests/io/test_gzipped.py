"""Scenes packed with gzip: the same values, errors that name the user's file, and nothing left behind."""

from __future__ import annotations

import gc
import gzip
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.errors import BudgetError, FormatError, InputError
from flexgs_edge.io.ply import PlySource
from flexgs_edge.run.open_scene import MOST_TIMES, SMALL, unpacked
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import SceneSource
from scene_files import open_scene, random_rows, write_rows

ALL = [field.name for field in FIELDS]


@pytest.fixture
def packed(tmp_path: Path) -> Path:
    """A PLY and the same packed beside it."""
    plain = write_rows(tmp_path / "a.ply", random_rows(30, 1))
    (tmp_path / "a.ply.gz").write_bytes(gzip.compress(plain.read_bytes()))
    return tmp_path / "a.ply.gz"


def test_the_same_values_by_any_rows(packed: Path, own_temporary_folder: Path) -> None:
    source, plain = open_scene(packed), open_scene(packed.with_suffix(""))
    assert source.name == str(packed) and source.notes == plain.notes
    for rows in (slice(0, 30), slice(7, 9), np.array([2, 3, 20])):
        for field, values in source.read(rows, ALL).items():
            np.testing.assert_array_equal(values, plain.read(rows, [field])[field])


def test_the_unpacked_file_lives_as_long_as_the_source(packed: Path, own_temporary_folder: Path) -> None:
    source = open_scene(packed)
    part = source.select(np.array([3, 1]))
    assert len(list(own_temporary_folder.iterdir())) == 1
    del source
    gc.collect()
    assert part.read(slice(0, 2), ["means"])["means"].shape == (3, 2)
    del part
    gc.collect()
    assert list(own_temporary_folder.iterdir()) == []


def test_damaged_files(packed: Path, own_temporary_folder: Path) -> None:
    whole = packed.read_bytes()
    flipped = bytearray(whole)
    flipped[len(whole) // 2] ^= 1
    wrong_sum = bytearray(whole)
    wrong_sum[-6] ^= 1
    for data in (whole[: len(whole) // 2], whole[:-1], whole[:12], bytes(flipped), bytes(wrong_sum), whole + b"junk"):
        packed.write_bytes(data)
        with pytest.raises(FormatError) as caught:
            open_scene(packed)
        assert str(caught.value).startswith(f"{packed}: not a whole gzip file")
        assert str(own_temporary_folder) not in str(caught.value)
    assert list(own_temporary_folder.iterdir()) == []


@pytest.mark.parametrize(
    ("inner", "words"),
    [
        (b"ply\nformat ascii 1.0\nend_header\n", "no element 'vertex'"),
        (b"", "this is an empty file"),
        (b"hello", "not a PLY file"),
        (b"<html>", "this is an HTML page"),
        (b"\x89PNG\r\n\x1a\n", "this is a PNG image"),
    ],
)
def test_damage_inside_names_the_users_file(packed: Path, own_temporary_folder: Path, inner: bytes, words: str) -> None:
    packed.write_bytes(gzip.compress(inner))
    with pytest.raises(FormatError) as caught:
        open_scene(packed)
    assert str(caught.value).startswith(f"{packed}: {words}")
    assert str(own_temporary_folder) not in str(caught.value)
    assert list(own_temporary_folder.iterdir()) == []


def test_a_bomb(packed: Path, own_temporary_folder: Path) -> None:
    packed.write_bytes(gzip.compress(bytes(SMALL + 5_000_000), 9))
    with pytest.raises(FormatError, match=f"unpacks to more than {SMALL} bytes, {MOST_TIMES} times its size"):
        open_scene(packed)
    assert list(own_temporary_folder.iterdir()) == []


def test_a_disk_without_room(packed: Path, own_temporary_folder: Path) -> None:
    with pytest.raises(BudgetError, match=r"a\.ply\.gz: unpacked, it does not fit .* let TMPDIR name another folder"):
        unpacked(packed, str(packed), PlySource, least_free=2**62)
    assert list(own_temporary_folder.iterdir()) == []


def test_errors_of_the_reader_clean_up(packed: Path, own_temporary_folder: Path) -> None:
    def interrupted(path: Path) -> SceneSource:
        assert path.is_file()
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        unpacked(packed, "a.ply.gz", interrupted)
    assert list(own_temporary_folder.iterdir()) == []


def test_no_such_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="none.ply.gz: no such file"):
        unpacked(tmp_path / "none.ply.gz", "none.ply.gz", PlySource)
    with pytest.raises(InputError, match="x.ply.gz: expected a file, found a folder"):
        unpacked(tmp_path, "x.ply.gz", PlySource)
