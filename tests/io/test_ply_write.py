"""Writing PLY scenes: INRIA's layout byte for byte, by chunks, and back."""

from __future__ import annotations

import os
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.commands.decompress import decompress
from flexgs_edge.errors import BudgetError, InputError
from flexgs_edge.io.exchange import wants_double
from flexgs_edge.io.frames import RUB, in_frame
from flexgs_edge.io.ply import PlySource, inria_dtype, write_ply
from flexgs_edge.io.reading import Writing
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource
from scene_files import header, property_names, random_rows, write_rows

ALL = [field.name for field in FIELDS]
SAMPLE = Path(__file__).parents[2] / "samples" / "still_life" / "point_cloud.ply"


def scene(count: int, degree: int, origin: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> MemorySource:
    rng = np.random.default_rng(count + degree)
    arrays = {f.name: rng.normal(size=(f.width(degree), count)).astype(np.float32) for f in FIELDS}
    return MemorySource(arrays, origin=origin, sh_degree=degree)


@pytest.mark.parametrize("count", [0, 1, 13])
@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_round_trip_of_every_degree(tmp_path: Path, count: int, degree: int) -> None:
    source = scene(count, degree)
    assert write_ply(tmp_path / "a.ply", source, chunk_rows=5) == ()
    back = PlySource(tmp_path / "a.ply")
    assert back.origin.tolist() == [0.0, 0.0, 0.0]
    rows = slice(0, count)
    for name, plane in source.read(rows, ALL).items():
        np.testing.assert_array_equal(back.read(rows, [name])[name], plane)


@pytest.mark.parametrize("degree", [0, 3])
def test_the_layout_is_inrias(tmp_path: Path, degree: int) -> None:
    rows = random_rows(6, degree)
    for name in ("nx", "ny", "nz"):
        rows[name] = 0.0
    write_rows(tmp_path / "a.ply", rows)
    write_ply(tmp_path / "b.ply", PlySource(tmp_path / "a.ply"))
    assert (tmp_path / "b.ply").read_bytes() == header(rows) + rows.tobytes()
    assert list(inria_dtype(degree).names or ()) == property_names(degree)


@pytest.mark.parametrize("chunk_rows", [4000, 65536])
def test_the_sample_comes_back_byte_for_byte(tmp_path: Path, chunk_rows: int) -> None:
    write_ply(tmp_path / "a.ply", PlySource(SAMPLE), chunk_rows=chunk_rows)
    assert (tmp_path / "a.ply").read_bytes() == SAMPLE.read_bytes()


def test_a_scene_far_from_zero_is_written_in_float64(tmp_path: Path) -> None:
    source = scene(50, 1, origin=(4e6, -5e5, 0.0))
    assert write_ply(tmp_path / "a.ply", source, double=True) == ("positions written as double",)
    assert b"property double x\n" in (tmp_path / "a.ply").read_bytes()
    back = PlySource(tmp_path / "a.ply")
    expected = source.read(slice(0, 50), ["means"])["means"] + source.origin[:, None]
    found = back.read(slice(0, 50), ["means"])["means"] + back.origin[:, None]
    assert np.abs(found - expected).max() < 1e-6


@pytest.mark.parametrize("shift", [0, 4e6])
@pytest.mark.parametrize("double", ["", "x"])
def test_the_type_that_comes_in_goes_out(tmp_path: Path, shift: float, double: str) -> None:
    rows = random_rows(50, 0, double=double)
    rows["x"] += shift
    path = write_rows(tmp_path / "a.ply", rows)
    # One chosen row after another, turned and back: what wraps a source keeps what came in.
    source = in_frame(in_frame(PlySource(path), RUB), RUB).select(np.arange(50))
    assert wants_double(source) == (bool(double), ())
    decompress(path, tmp_path / "b.ply", writing=Writing(double=True))
    assert b"property double z\n" in (tmp_path / "b.ply").read_bytes()
    with pytest.raises(InputError, match=r"--double: only a \.ply .*not \.spz"):
        decompress(path, tmp_path / "b.spz", writing=Writing(double=True))


def test_unknown_types_are_floats_where_these_hold(tmp_path: Path) -> None:
    planes = scene(50, 1).read(slice(0, 50), ALL)
    planes["log_scales"][:] = -4.0
    near = MemorySource(planes, origin=np.array([1000.0, 0, 0]))
    assert wants_double(near) == (False, ())
    planes["log_scales"][:, 7] = -9.0
    double, (words,) = wants_double(MemorySource(planes, origin=np.array([4000.0, 0, 0])))
    expected = "floats hold positions of this scene only to 0.00012, and the smallest splat measures 0.00012: --double "
    assert not double and words.startswith(expected)
    assert wants_double(MemorySource(planes, origin=np.array([4e6, 0, 0]))) == (True, ())


def test_floats_far_from_zero_come_back_as_floats(tmp_path: Path) -> None:
    rows = random_rows(50, 0)
    for name in ("nx", "ny", "nz"):
        rows[name] = 0.0
    rows["x"] += np.float32(4e6)
    path = write_rows(tmp_path / "a.ply", rows)
    assert PlySource(path).origin[0] != 0
    assert write_ply(tmp_path / "b.ply", PlySource(path)) == ()
    assert (tmp_path / "b.ply").read_bytes() == path.read_bytes()


def test_it_opens_in_plyfile(tmp_path: Path) -> None:
    from plyfile import PlyData

    source = scene(7, 2)
    write_ply(tmp_path / "a.ply", source)
    vertex = PlyData.read(tmp_path / "a.ply", mmap=False)["vertex"]
    np.testing.assert_array_equal(vertex["f_rest_23"], source.read(slice(0, 7), ["sh_rest"])["sh_rest"][23])
    assert not vertex["ny"].any()


def test_no_overwrite_without_force(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.ply", random_rows(4))
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"a\.ply: the file exists.*-f"):
        write_ply(path, scene(2, 0))
    assert path.read_bytes() == before


def test_a_file_may_be_written_over_itself(tmp_path: Path) -> None:
    path = write_rows(tmp_path / "a.ply", random_rows(40, 1))
    source = PlySource(path)
    last = source.read(slice(39, 40), ALL)
    write_ply(path, source.select(np.arange(39, -1, -1)), force=True, chunk_rows=7)
    first = PlySource(path).read(slice(0, 1), ALL)
    for name in ALL:
        np.testing.assert_array_equal(first[name], last[name])


def test_a_full_disk_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, hard))
    try:
        with pytest.raises(BudgetError, match=r"a\.ply: the disk is full"):
            write_ply(tmp_path / "a.ply", scene(5000, 0))
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert os.listdir(tmp_path) == []


def test_memory_follows_the_chunk_not_the_scene(tmp_path: Path) -> None:
    source = PlySource(SAMPLE)
    tracemalloc.start()
    try:
        write_ply(tmp_path / "a.ply", source, chunk_rows=1000)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # A chunk as planes (236 B a row), as rows (248 B) and the reader's block of 1000 rows; the file has 8.2 MB.
    assert peak < 1.2e6


def test_what_a_scene_says_of_its_values_is_kept_and_other_comments_are_not(tmp_path: Path) -> None:
    source = scene(5, 1)
    source.comments = ("flexgs-edge grid {}",)
    write_ply(tmp_path / "a.ply", source)
    head = (tmp_path / "a.ply").read_bytes().split(b"end_header")[0].decode().splitlines()
    assert head[:4] == ["ply", "format binary_little_endian 1.0", "comment flexgs-edge grid {}", "element vertex 5"]
    back = PlySource(tmp_path / "a.ply")
    assert back.comments == source.comments
    np.testing.assert_array_equal(
        back.read(slice(0, 5), ["means"])["means"], source.read(slice(0, 5), ["means"])["means"]
    )
    data = (tmp_path / "a.ply").read_bytes().replace(b"comment flexgs-edge grid {}", b"comment of another, \xff")
    (tmp_path / "b.ply").write_bytes(data)
    assert PlySource(tmp_path / "b.ply").comments == ()
