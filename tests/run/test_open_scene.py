"""Opening scenes by path: by suffix, by first bytes, out of folders, and the paths that are no scene."""

from __future__ import annotations

import gzip
import os
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.commands.info import info
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.io.frames import RDF, RUB, FrameSource
from flexgs_edge.io.ply import PlySource
from flexgs_edge.io.reading import Reading
from flexgs_edge.run.inputs import load_scene
from flexgs_edge.run.open_scene import SUFFIXES, check_fgs, is_fgs, open_file, scene_file
from grid_scenes import make_grid
from scene_files import open_scene, random_rows, write_rows

ROWS = random_rows(3, 1)


@pytest.fixture
def ply(tmp_path: Path) -> Path:
    return write_rows(tmp_path / "a.ply", ROWS)


def means(source: object) -> np.ndarray:
    assert isinstance(source, (PlySource, FrameSource, GridSource))
    return source.read(slice(0, source.count), ["means"])["means"]


def test_a_ply_by_any_case_of_its_suffix(ply: Path) -> None:
    upper = ply.rename(ply.with_name("A.PLY"))
    source = open_scene(str(upper))
    assert isinstance(source, PlySource) and source.count == 3 and source.notes == ()


def test_what_is_known_of_a_file(ply: Path) -> None:
    found = open_file(ply)
    assert (found.suffix, found.bytes, found.frame, found.version) == (".ply", ply.stat().st_size, RDF, None)
    packed = ply.with_name("a.ply.gz")
    packed.write_bytes(gzip.compress(ply.read_bytes()))
    found = open_file(packed, Reading(RUB))
    assert (found.suffix, found.bytes, found.frame) == (".ply", packed.stat().st_size, RUB)


def test_a_fgs(tmp_path: Path) -> None:
    write_grid(tmp_path / "a.fgs", make_grid(9, 1), {"near": 0.2})
    found = open_file(tmp_path / "a.fgs")
    assert isinstance(found.source, GridSource) and found.suffix == ".fgs"
    turned = open_scene(tmp_path / "a.fgs", Reading(RUB))
    assert isinstance(turned, FrameSource)
    np.testing.assert_array_equal(means(turned), means(found.source) * np.array([[1], [-1], [-1]]))


@pytest.mark.parametrize("name", ["b", "b.txt", "b.spz", "b.fgs", "b.splat", "b.compressed.ply", "b.ply.gz", "b.glb"])
def test_a_ply_under_any_name(ply: Path, name: str) -> None:
    """Browsers unpack a .gz without a word, and programs call every file .ply."""
    source = open_scene(ply.rename(ply.with_name(name)))
    assert source.count == 3 and source.name.endswith(name)
    np.testing.assert_array_equal(means(source)[0], ROWS["x"])
    assert source.notes == (() if name == "b.ply.gz" else ("read as a PLY, as its first bytes say",))


def test_a_compressed_ply_under_the_name_of_a_plain_one(wild: Path, tmp_path: Path) -> None:
    shutil.copy(wild / "pc-guitar.compressed.ply", tmp_path / "a.ply")
    found = open_file(tmp_path / "a.ply")
    assert found.suffix == ".compressed.ply" and found.source.count == 90854
    assert found.source.notes[-1] == "read as a compressed PLY, as its first bytes say"


@pytest.mark.parametrize(
    ("name", "data", "words"),
    [
        ("a.ply", b"NGSP\4\0\0\0", "this is a .spz file: rename it to a.spz"),
        ("a.spz", b"glTF\2\0\0\0", "this is a binary glTF file: rename it to a.glb"),
        ("a.ply", b"\x93FGS\r\n\x1a\n\2\0", "this is a .fgs file: rename it to a.fgs"),
        ("a.ply", gzip.compress(b"ply\nformat", mtime=0), "this is a PLY packed with gzip: rename it to a.ply.gz"),
        ("a", gzip.compress(b"NGSP" + bytes(99), mtime=0), "this is a .spz file: rename it to a.spz"),
        ("a.splat", b"", "this is an empty file"),
        ("a.fgs", b"", "this is an empty file"),
        ("a.ply.gz", b"", "this is an empty file"),
        ("a.ply.gz", b"nothing known", "not a gzip file"),
        ("a.ply", b"version https://git-lfs.github.com/spec/v1\nsize 9\n", "this is a Git LFS pointer of 9 bytes"),
        ("a.spz", b"<!doctype html>", "this is an HTML page"),
        ("a.sog", b"<html>", "this is an HTML page"),
        ("a.png", b"\x89PNG\r\n\x1a\n", "this is a PNG image"),
        ("a.ply", b'[{"img_name": "a"}]', "this is a file of cameras"),
        ("a.ply", b"PK\x03\x04", "this is a zip archive"),
        ("a.ply", b"plx", "not a PLY file: expected 'ply' in the first line"),
    ],
)
def test_other_files(tmp_path: Path, name: str, data: bytes, words: str) -> None:
    (tmp_path / name).write_bytes(data)
    with pytest.raises(FormatError) as caught:
        open_scene(tmp_path / name)
    assert str(caught.value).startswith(f"{tmp_path / name}: {words}")


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("a.xyz", "unknown kind of scene '.xyz'; supported: files ending in .fgs, .ply"),
        ("a", "its name has no suffix that tells what it is; supported"),
        ("a.gz", "not a gzip file"),
    ],
)
def test_suffixes_that_are_not_known(tmp_path: Path, name: str, words: str) -> None:
    (tmp_path / name).write_bytes(b"something else")
    with pytest.raises(InputError) as caught:
        open_scene(tmp_path / name)
    assert f"{name}: {words}" in str(caught.value)


def test_a_fgs_packed_with_gzip(tmp_path: Path) -> None:
    write_grid(tmp_path / "a.fgs", make_grid(9, 1), {"near": 0.2})
    (tmp_path / "a.fgs.gz").write_bytes(gzip.compress((tmp_path / "a.fgs").read_bytes()))
    with pytest.raises(InputError, match=r"a\.fgs\.gz: a \.fgs does not get smaller by gzip; unpack it first"):
        open_scene(tmp_path / "a.fgs.gz")


def test_paths_that_are_no_file(tmp_path: Path) -> None:
    (tmp_path / "link.ply").symlink_to(tmp_path / "gone.ply")
    (tmp_path / "loop.ply").symlink_to(tmp_path / "loop.ply")
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "file").touch()
    for path, words in (
        (tmp_path / "none.ply", "none.ply: no such file or folder; supported: .*ply"),
        (tmp_path / "link.ply", r"link.ply: a link to .*gone\.ply, which does not exist"),
        (tmp_path / "loop.ply", "loop.ply: cannot read it"),
        (tmp_path / "pipe.ply", "pipe.ply: expected a file, found a pipe"),
        (Path("/dev/zero"), "/dev/zero: expected a file, found a device"),
        (tmp_path / "file" / "a.ply", "a.ply: no such file or folder"),
        (tmp_path / ("long" * 100), "no such file or folder|cannot read it"),
        (Path("a\0b.ply"), "no such file or folder|cannot be the name of a file"),
    ):
        with pytest.raises(InputError, match=words):
            open_scene(path)
        with pytest.raises(InputError):
            check_fgs(path)


def test_a_socket(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)  # the name of a socket has at most 107 bytes
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("s.ply")
        with pytest.raises(InputError, match=r"s\.ply: expected a file, found a socket"):
            open_scene("s.ply")


@pytest.mark.skipif(os.geteuid() == 0, reason="root reads every file")
def test_a_file_without_the_right_to_read_it(ply: Path) -> None:
    ply.chmod(0)
    with pytest.raises(InputError, match=r"a\.ply: cannot read it \(Permission denied\)"):
        open_scene(ply)


def test_folders(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no point_cloud/iteration"):
        open_scene(tmp_path)
    (tmp_path / "meta.json").touch()
    assert scene_file(tmp_path) == tmp_path / "meta.json"
    (tmp_path / "lod-meta.json").touch()
    assert scene_file(tmp_path) == tmp_path / "lod-meta.json"


def test_a_level_is_for_streamed_scenes(ply: Path) -> None:
    with pytest.raises(InputError, match=r"a\.ply: --lod is for streamed scenes"):
        open_scene(ply, Reading(lod=1))


def test_a_scene_that_is_open_cannot_be_read_in_another_frame(ply: Path) -> None:
    scene = load_scene(ply)
    for reading in (Reading(RUB), Reading(lod=0)):
        with pytest.raises(InputError, match=r"this scene is open: give them to Scene\.open"):
            load_scene(scene, reading=reading)
    assert load_scene(scene).source is scene.source
    assert load_scene(scene, reading=Reading(sh_degree=0)).source.sh_degree == 0


def test_every_format_is_named(tmp_path: Path) -> None:
    assert set(FORMATS) < set(SUFFIXES)
    with pytest.raises(InputError) as caught:
        open_scene(tmp_path / "none.xyz")
    assert all(suffix in str(caught.value) for suffix in SUFFIXES)


def test_files_that_are_no_fgs(tmp_path: Path, ply: Path) -> None:
    write_grid(tmp_path / "a.fgs", make_grid(9, 1), {"near": 0.2})
    check_fgs(tmp_path / "a.fgs")
    assert is_fgs(tmp_path / "a.fgs") and not is_fgs(ply)
    with pytest.raises(InputError, match="this is a PLY: rename it to b.ply"):
        check_fgs(ply.rename(tmp_path / "b.fgs"))
    assert not is_fgs(tmp_path / "b.fgs") and info(tmp_path / "b.fgs").format == "ply"
