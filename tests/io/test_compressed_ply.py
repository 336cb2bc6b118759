"""Compressed PLY: round trips within each chunk's steps, what others read, and damaged files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from exchanged import degrees_apart, largest_errors, opacities, planes_of, psnr_after, refused, scene, there_and_back
from flexgs_edge.io.compressed_ply import CHUNK
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.ply import PlySource, write_ply
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.source import MemorySource
from scene_files import edit
from synthetic import random_scene

NAME = "a.compressed.ply"
HEADER = "ply\nformat binary_{}_endian 1.0\nelement chunk 1\n{}element vertex 2\n{}{}end_header\n"
RANGES = ("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b")


def golden(order: str = "<", colours: bool = True, sh: int = 9) -> bytes:
    """Two Gaussians at the ends of all ranges."""
    ranges = RANGES if colours else RANGES[:2]
    chunk = "".join(f"property float {end}_{axis}\n" for axes in ranges for end in ("min", "max") for axis in axes)
    words = "".join(f"property uint packed_{name}\n" for name in ("position", "rotation", "scale", "color"))
    rest = "element sh 2\n" + "".join(f"property uchar f_rest_{i}\n" for i in range(sh)) if sh else ""
    head = HEADER.format("little" if order == "<" else "big", chunk, words, rest)
    values = np.array([-1, -2, -3, 1, 2, 3, -6, -5, -4, -3, -2, -1, 0, 0.1, 0.2, 1, 1.1, 1.2], order + "f4")
    # w is the largest of the first and z of the second; the middle of 10 bits is close to 0.
    rows = np.array([[0, 512 << 20 | 512 << 10 | 512, 0, 0x00000033], [2**32 - 1, 3 << 30 | 512 << 20 | 512 << 10 | 512,
                     2**32 - 1, 0xFFFFFF00 | 204]], order + "u4")  # fmt: skip
    codes = np.array([[0, 255, 128, *range(sh - 3)], [127] * sh], "u1") if sh else np.zeros((0, 0), "u1")
    return head.encode() + values[: 18 if colours else 12].tobytes() + rows.tobytes() + codes.tobytes()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("colours", [True, False])
def test_golden_bytes(tmp_path: Path, order: str, colours: bool) -> None:
    path = tmp_path / NAME
    path.write_bytes(golden(order, colours))
    source = read_foreign(path)
    planes = planes_of(source)
    assert (source.count, source.sh_degree, source.notes) == (2, 1, ())
    np.testing.assert_allclose(planes["means"].T, [[-1, -2, -3], [1, 2, 3]])
    np.testing.assert_allclose(planes["log_scales"].T, [[-6, -5, -4], [-3, -2, -1]])
    ends = [[0, 0.1, 0.2], [1, 1.1, 1.2]] if colours else [[0, 0, 0], [1, 1, 1]]
    np.testing.assert_allclose(planes["sh_dc"].T * 0.28209479 + 0.5, ends, atol=1e-6)
    np.testing.assert_allclose(opacities(planes)[0], [0.2, 0.8])
    assert degrees_apart(planes["quats"], np.array([[1, 0], [0, 0], [0, 0], [0, 1]])).max() < 0.3
    np.testing.assert_allclose(planes["sh_rest"][:4, 0], [-4, 4, 4 / 256, (0.0 - 0.5) * 8])
    np.testing.assert_allclose(planes["sh_rest"][:, 1], -4 / 256)


def test_without_sh(tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_bytes(golden(sh=0))
    assert read_foreign(path).sh_degree == 0


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_round_trips(tmp_path: Path, degree: int) -> None:
    """Half a step of the ranges of all values; most chunks have smaller ones."""
    bounds = {"means": 6 / 1023 / 2, "log_scales": 6 / 1023 / 2, "sh_dc": 3 / 255 / 2, "sh_rest": 1 / 64, "quats": 0.2}
    errors = largest_errors(*there_and_back(tmp_path / NAME, scene(600, degree)))
    for field, bound in {**bounds, "opacity_logits": 0.5 / 255}.items():
        assert errors[field] <= bound * 1.001, field


@pytest.mark.parametrize("count", [1, 2, 255, 256, 257])
def test_counts_round_a_chunk(tmp_path: Path, count: int) -> None:
    before, after = there_and_back(tmp_path / NAME, scene(count, 0))
    errors = largest_errors(before, after)
    assert errors["means"] <= 6 / 1023 / 2 * 1.001
    # The ends of a range are exact.
    first = slice(0, min(count, CHUNK))
    np.testing.assert_array_equal(after["means"][:, first].min(axis=1), before["means"][:, first].min(axis=1))
    if count == 1:
        assert errors["means"] == errors["log_scales"] == 0


def test_pictures_stay(tmp_path: Path) -> None:
    assert psnr_after(tmp_path / NAME, random_scene(50, degree=3)) > 40


def test_sh_take_the_nearest_code(tmp_path: Path) -> None:
    values = np.linspace(-4.2, 4.2, 3000, dtype=np.float32)
    planes = planes_of(scene(3000, 1))
    planes["sh_rest"][:] = values
    source = MemorySource(planes, 1)
    before, after = there_and_back(tmp_path / NAME, source)
    codes = np.array([-4, *((np.arange(1, 255) + 0.5) / 256 - 0.5) * 8, 4])
    nearest = np.abs(codes[None] - before["sh_rest"][0][:, None]).min(axis=1)
    np.testing.assert_allclose(np.abs(after["sh_rest"][0] - before["sh_rest"][0]), nearest, atol=1e-6)


def test_values_beyond_the_codes(tmp_path: Path) -> None:
    planes = planes_of(scene(4, 0))
    planes["opacity_logits"][0] = [-500, 500, 0, 0]
    planes["log_scales"][0] = [-50, 50, -np.inf, 0]
    planes["means"][0] = [3e38, -3e38, 0, 0]
    source = MemorySource(planes, 0)
    _, after = there_and_back(tmp_path / NAME, source)
    rows = np.argsort(near_order(source, chunked=True))
    np.testing.assert_allclose(after["opacity_logits"][0, rows], [-7, 7, 0, 0], atol=0.01)
    np.testing.assert_allclose(after["log_scales"][0, rows], [-20, 20, -20, 0], atol=0.02)
    np.testing.assert_allclose(after["means"][0, rows[:2]], [3e38, -3e38])


def test_large_files_are_written_in_parts(tmp_path: Path) -> None:
    """A part boundary of the writer inside the scene; every chunk has its own ranges."""
    source = scene(17_000, 0)
    before, after = there_and_back(tmp_path / NAME, source)
    for start in range(0, 17_000, CHUNK):
        part = slice(start, start + CHUNK)
        low, high = before["means"][:, part].min(axis=1), before["means"][:, part].max(axis=1)
        bound = (high - low) / [2047, 1023, 2047] / 2 * 1.001
        assert (np.abs(before["means"][:, part] - after["means"][:, part]).max(axis=1) <= bound).all()


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_other_programs_read_the_same(tmp_path: Path) -> None:
    gaussforge, gsply = pytest.importorskip("gaussforge"), pytest.importorskip("gsply")
    path = tmp_path / NAME
    write_foreign(path, scene(300, 3, seed=1))
    ours = planes_of(read_foreign(path))
    made = gaussforge.GaussForge().convert(path.read_bytes(), "compressed.ply", "ply")
    (tmp_path / "b.ply").write_bytes(made["data"])
    theirs = planes_of(PlySource(tmp_path / "b.ply"))
    for field in ("means", "log_scales", "sh_dc", "sh_rest"):
        np.testing.assert_allclose(theirs[field], ours[field], atol=1e-5, err_msg=field)
    assert degrees_apart(theirs["quats"], ours["quats"]).max() < 0.01
    found = gsply.plyread(str(path))
    np.testing.assert_allclose(np.asarray(found.means).T, ours["means"], atol=1e-5)
    np.testing.assert_allclose(np.asarray(found.shN).transpose(2, 1, 0).reshape(45, -1), ours["sh_rest"], atol=1e-5)


def test_a_file_of_others(wild: Path) -> None:
    source = read_foreign(wild / "pc-guitar.compressed.ply")
    assert (source.count, source.sh_degree, source.notes) == (90_854, 0, ())
    assert check_scene(source) is source


def test_truncations(tmp_path: Path) -> None:
    data = golden()
    for size in (*range(0, len(data), 17), *range(len(data) - 30, len(data))):
        refused(tmp_path / NAME, data[:size])


def test_wrong_headers(tmp_path: Path) -> None:
    path, good = tmp_path / NAME, golden()
    for old, new, words in (
        ("element chunk 1", "element chunk 2", "element 'chunk': expected 1 rows for 2 vertices, found 2"),
        ("element chunk 1", "element pieces 1", "no element 'chunk'; found pieces, vertex, sh"),
        ("element vertex 2", "element vertex 999999999999", "element 'chunk': expected 3906250000 rows"),
        ("element sh 2", "element sh 3", "element 'sh': expected 2 rows, found 3"),
        ("property uchar f_rest_8\n", "", "expected 9, 24 or 45 properties, found 8"),
        ("f_rest_8", "f_rest_9", "expected property 'f_rest_8' of type uchar, found none"),
        ("uchar f_rest_8", "ushort f_rest_8", "'f_rest_8' of type uchar, found u2"),
        ("property float max_scale_z\n", "", "expected property 'max_scale_z' of type float, found none"),
        ("property float max_b\n", "", "expected property 'max_b' of type float, found none"),
        ("uint packed_scale", "int packed_scale", "'packed_scale' of type uint, found i4"),
        ("binary_little_endian", "ascii", "a compressed PLY is binary"),
        ("element sh 2", "element sh 2\nproperty list uchar int i", "element 'sh' has lists"),
        ("end_header", "element none 3\nend_header", "element 'none' has 3 rows without properties"),
    ):
        assert words in refused(path, edit(good, old, new)), new
    assert "expected 'ply' at byte 0, found b'PK" in refused(path, b"PK\x03\x04" + bytes(90))
    write_ply(tmp_path / "b.ply", scene(2, 0))
    assert "rename an INRIA PLY" in refused(path, (tmp_path / "b.ply").read_bytes())


def test_more_than_is_read(tmp_path: Path) -> None:
    path = tmp_path / NAME
    path.write_bytes(golden() + bytes(5))
    assert read_foreign(path).notes == ("5 bytes behind the data ignored",)
    path.write_bytes(edit(golden(), "end_header", "element more 1\nproperty uchar i\nend_header") + b"\1")
    assert read_foreign(path).notes == ("element 'more' left out (1 rows)",)


def test_no_gaussians(tmp_path: Path) -> None:
    head = golden().split(b"end_header\n")[0].replace(b"chunk 1", b"chunk 0").replace(b"x 2", b"x 0")
    path = tmp_path / NAME
    path.write_bytes(head.replace(b"sh 2", b"sh 0") + b"end_header\n")
    assert read_foreign(path).count == 0


def test_other_orders_of_elements_and_properties(tmp_path: Path) -> None:
    path, good = tmp_path / NAME, golden()
    path.write_bytes(good)
    plain = planes_of(read_foreign(path))
    swapped = edit(edit(edit(good, "f_rest_0\n", "f_rest_X\n"), "f_rest_8\n", "f_rest_0\n"), "f_rest_X\n", "f_rest_8\n")
    path.write_bytes(swapped)
    np.testing.assert_array_equal(planes_of(read_foreign(path))["sh_rest"][[8, *range(1, 8), 0]], plain["sh_rest"])


def test_rows_in_any_order(tmp_path: Path) -> None:
    write_foreign(tmp_path / NAME, scene(600, 1))
    source = read_foreign(tmp_path / NAME)
    rows = np.array([0, 255, 256, 300, 599])
    for field, plane in planes_of(source).items():
        np.testing.assert_array_equal(source.read(rows, [field])[field], plane[:, rows])
    assert source.held_bytes == 3 * 18 * 8 + 600 * (16 + 9)
