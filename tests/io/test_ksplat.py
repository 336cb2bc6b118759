"""`.ksplat`: all levels and degrees, buckets that are full and not, several sections, and damaged files."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from exchanged import degrees_apart, opacities, planes_of, refused, scene
from flexgs_edge.errors import InputError
from flexgs_edge.io.exchange import read_foreign, write_foreign
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import sh_rest_count
from flexgs_edge.scene.source import Planes
from ksplat_files import Part, ksplat

BOUNDS = (
    {"means": 0.0, "log_scales": 1e-6, "sh_rest": 0.0, "degrees": 1e-3},
    {"means": 4e-5, "log_scales": 1e-3, "sh_rest": 3e-4, "degrees": 0.1},
    {"means": 4e-5, "log_scales": 1e-3, "sh_rest": 0.0059, "degrees": 0.1},
)
"""Half a step of each level."""


def part(count: int, degree: int, capacity: int, sizes: list[int], seed: int = 0, room: int = 0) -> tuple[Part, Planes]:
    planes = planes_of(scene(count, degree, seed, spread=0.9))
    planes["quats"] /= np.linalg.norm(planes["quats"], axis=0)
    return Part(planes, degree, sizes, capacity, room), planes


def check(found: Planes, planes: Planes, level: int) -> None:
    bounds = BOUNDS[level]
    for field in ("means", "log_scales", "sh_rest"):
        assert np.abs(found[field] - planes[field]).max(initial=0) <= bounds[field], field
    assert np.abs(found["sh_dc"] - planes["sh_dc"]).max() <= 0.501 / 255 / 0.282
    assert np.abs(opacities(found) - opacities(planes)).max() <= 0.501 / 255
    assert degrees_apart(found["quats"], planes["quats"]).max() <= bounds["degrees"]


@pytest.mark.parametrize("level", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_levels_and_degrees(tmp_path: Path, level: int, degree: int) -> None:
    section, planes = part(23, degree, 8, [8, 8, 5, 2])
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(level, [section]))
    source = read_foreign(path)
    assert (source.count, source.sh_degree, source.notes, source.name) == (23, degree, (), str(path))
    check(planes_of(source), planes, level)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_sections(tmp_path: Path, level: int) -> None:
    """Of different degrees, one with room for more, one of full buckets alone, one of none; and spare headers."""
    parts = [part(10, 1, 4, [4, 4, 2], room=3), part(8, 2, 4, [4, 4], seed=1), part(3, 0, 256, [1, 2], seed=2)]
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(level, [section for section, _ in parts], spare_sections=2))
    source = read_foreign(path)
    assert (source.count, source.sh_degree) == (21, 2)
    found, start = planes_of(source), 0
    for section, planes in parts:
        rows = slice(start, start + planes["means"].shape[1])
        start = rows.stop
        some = {field: plane[:, rows] for field, plane in found.items()}
        rest = some["sh_rest"].reshape(3, 8, -1)
        count = sh_rest_count(section.degree)
        assert not rest[:, count:].any()
        check({**some, "sh_rest": rest[:, :count].reshape(3 * count, len(section.planes["means"][0]))}, planes, level)
    rows = np.array([0, 9, 10, 11, 17, 18, 20])
    for field, plane in found.items():
        np.testing.assert_array_equal(source.read(rows, [field])[field], plane[:, rows])


def test_the_header_states_the_range_of_sh(tmp_path: Path) -> None:
    section, _ = part(3, 1, 4, [3])
    data = bytearray(ksplat(2, [section]))
    path = tmp_path / "a.ksplat"
    path.write_bytes(bytes(data))
    before = planes_of(read_foreign(path))["sh_rest"]
    struct.pack_into("<ff", data, 36, -3, 3)
    path.write_bytes(bytes(data))
    np.testing.assert_allclose(planes_of(read_foreign(path))["sh_rest"], 2 * before, rtol=1e-6)


def test_scales_of_zero_are_flat(tmp_path: Path) -> None:
    section, planes = part(4, 0, 4, [4])
    planes["log_scales"][1, 2] = -np.inf
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(0, [section]))
    assert planes_of(read_foreign(path))["log_scales"][1, 2] == -np.inf
    assert "1 flat Gaussians" in check_scene(read_foreign(path)).notes[0]


def test_a_file_of_others(wild: Path) -> None:
    ours, theirs = (planes_of(read_foreign(wild / f"st-minimal.{suffix}")) for suffix in ("ksplat", "splat"))
    for field in ("means", "log_scales", "sh_dc", "opacity_logits"):
        np.testing.assert_allclose(ours[field], theirs[field], atol=1e-6)
    assert degrees_apart(ours["quats"], theirs["quats"]).max() < 1


@pytest.mark.parametrize("level", [0, 2])
def test_truncations(tmp_path: Path, level: int) -> None:
    data = ksplat(level, [part(5, 1, 4, [4, 1])[0]])
    for size in (*range(0, len(data), 61), *range(len(data) - 40, len(data))):
        refused(tmp_path / "a.ksplat", data[:size])


def test_wrong_fields(tmp_path: Path) -> None:
    path, good = tmp_path / "a.ksplat", ksplat(1, [part(5, 1, 4, [4, 1])[0]])

    def changed(at: int, form: str, value: float) -> bytes:
        made = bytearray(good)
        struct.pack_into(form, made, at, value)
        return bytes(made)

    for at, form, value, words in (
        (0, "<B", 1, "expected 0.1, found 1.1"),
        (1, "<B", 0, "expected 0.1, found 0.0"),
        (4, "<I", 2**32 - 1, "promises 4294967295 sections"),
        (16, "<I", 6, "the sections have 5, found 6"),
        (20, "<H", 3, "compression level: expected 0 to 2, found 3"),
        (4096, "<I", 6, "number of Gaussians: expected at most 5, found 6"),
        (4104, "<I", 3, "expected room for 5 Gaussians in 2 buckets"),
        (4108, "<I", 2**32 - 1, "truncated"),
        (4108, "<I", 1, "in 1 buckets"),
        (4116, "<H", 16, "bytes of a bucket: expected 12, found 16"),
        (4128, "<I", 2**32 - 1, "expected room"),
        (4132, "<I", 2**32 - 1, "truncated"),
        (4136, "<H", 4, "SH degree: expected 0 to 3, found 4"),
    ):
        assert words in refused(path, changed(at, form, value)), at
    # Whatever the file says of its blocks, values are read; what is not finite is reported.
    path.write_bytes(changed(4112, "<f", float("nan")))
    with pytest.raises(InputError, match="NaN or infinity in means"):
        check_scene(read_foreign(path))


def test_bytes_behind_are_noted(tmp_path: Path) -> None:
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(0, [part(5, 0, 4, [4, 1])[0]]) + bytes(3))
    assert read_foreign(path).notes == ("3 bytes behind the data ignored",)


def test_no_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "a.ksplat"
    path.write_bytes(ksplat(1, [], spare_sections=1))
    assert read_foreign(path).count == 0


def test_it_is_not_written(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="are only read; write one of"):
        write_foreign(tmp_path / "a.ksplat", scene(3))
