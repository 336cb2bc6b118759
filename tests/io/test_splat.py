"""`.splat`: round trips within its steps, golden bytes, and files that are none."""

from __future__ import annotations

import io
import struct
from pathlib import Path

import numpy as np
import pytest

from exchanged import degrees_apart, largest_errors, planes_of, psnr_after, refused, scene, there_and_back
from flexgs_edge.errors import InputError
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.ply import PlySource
from flexgs_edge.io.reading import PLAIN
from flexgs_edge.io.splat import write_splat
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.source import MemorySource
from scene_files import open_scene
from synthetic import random_scene


@pytest.mark.parametrize("count", [1, 2, 300])
def test_round_trips(tmp_path: Path, count: int) -> None:
    errors = largest_errors(*there_and_back(tmp_path / "a.splat", scene(count, 0)))
    assert errors["means"] == 0 and errors["log_scales"] < 1e-6
    assert errors["sh_dc"] <= 0.501 / 255 / 0.282 and errors["opacity_logits"] <= 0.501 / 255
    assert errors["quats"] <= 0.95
    assert (tmp_path / "a.splat").stat().st_size == 32 * count


def test_pictures_stay(tmp_path: Path) -> None:
    assert psnr_after(tmp_path / "a.splat", random_scene(50)) > 40


def test_golden_bytes(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    row = struct.pack("<6f8B", 1, -2, 0.5, 1, 0.25, 0, 255, 0, 51, 204, 128, 0, 128, 128)
    path.write_bytes(row)
    source = read_foreign(path)
    planes = planes_of(source)
    assert (source.count, source.sh_degree, source.notes, source.held_bytes) == (1, 0, (), 32)
    np.testing.assert_array_equal(planes["means"][:, 0], [1, -2, 0.5])
    np.testing.assert_allclose(planes["log_scales"][:, 0], [0, np.log(0.25), -np.inf])
    np.testing.assert_allclose(planes["sh_dc"][:, 0] * 0.28209479 + 0.5, [1, 0, 0.2], atol=1e-6)
    assert planes["opacity_logits"][0, 0] == pytest.approx(np.log(4))
    np.testing.assert_array_equal(planes["quats"][:, 0], [0, -1, 0, 0])
    write_foreign(tmp_path / "b.splat", source)
    assert (tmp_path / "b.splat").read_bytes() == row


def test_rotations_along_an_axis_are_exact(tmp_path: Path) -> None:
    """The codes hold -1, but not 1, and q and -q are one rotation."""
    planes = planes_of(scene(4, 0)) | {"quats": np.eye(4, dtype=np.float32)}
    before, after = there_and_back(tmp_path / "a.splat", MemorySource(planes, 0))
    assert degrees_apart(before["quats"], after["quats"]).max() == 0


def test_values_beyond_the_codes(tmp_path: Path) -> None:
    planes = planes_of(scene(3, 0))
    planes["opacity_logits"][0] = [-500, 500, 0]
    planes["log_scales"][0] = [-200, 200, -np.inf]
    planes["sh_dc"][0] = [-9, 9, 0]
    source = MemorySource(planes, 0)
    _, after = there_and_back(tmp_path / "a.splat", source)
    rows = np.argsort(near_order(source))
    np.testing.assert_allclose(after["opacity_logits"][0, rows], [-7, 7, 0], atol=0.01)
    np.testing.assert_allclose(after["log_scales"][0, rows], [-np.inf, 88.72284, -np.inf])
    np.testing.assert_allclose(after["sh_dc"][0, rows] * 0.28209479, [-0.5, 0.5, 0], atol=0.002)


def test_the_same_bytes_as_chunk_by_chunk() -> None:
    """A scene larger than the writer's chunks."""
    source, whole = scene(70_000, 0), io.BytesIO()
    write_splat(whole, source, PLAIN)
    parts = io.BytesIO()
    for rows in source.chunks(1000):
        write_splat(parts, source.select(np.arange(rows.start, rows.stop)), PLAIN)
    assert whole.getvalue() == parts.getvalue()


def test_files_of_others(wild: Path) -> None:
    assert read_foreign(wild / "st-minimal.splat").count == 4
    ours, theirs = planes_of(read_foreign(wild / "ms-train3.splat")), planes_of(PlySource(wild / "ms-train3.ply"))
    rows = [int(np.abs(theirs["means"].T - place).sum(axis=1).argmin()) for place in ours["means"].T]
    assert sorted(rows) == [0, 1, 2]
    for field, bound in (("means", 1e-5), ("log_scales", 1e-4), ("sh_dc", 0.015)):
        np.testing.assert_allclose(ours[field], theirs[field][:, rows], atol=bound)
    assert degrees_apart(ours["quats"], theirs["quats"][:, rows]).max() < 1.5


def test_what_is_not_a_splat(tmp_path: Path) -> None:
    path, row = tmp_path / "a.splat", struct.pack("<6f8B", 1, -2, 0.5, 1, 1, 1, *[128] * 7, 255)
    for data in (b"", row[:31], row + b"\0", (row * 3)[:-1]):
        assert "expected a multiple of 32 bytes" in refused(path, data)
    # Two bytes of gzip may be a coordinate.
    path.write_bytes(b"\x1f\x8b\x08\x3f" + row[4:])
    assert open_scene(path).count == 1


def test_values_that_are_not_numbers_are_reported(tmp_path: Path) -> None:
    path = tmp_path / "a.splat"
    path.write_bytes(struct.pack("<6f8B", np.nan, 0, 0, -1, 1, 1, *[128] * 8))
    with pytest.raises(InputError, match=r"means in 1 .*log_scales in 1 .*quats of norm zero"):
        check_scene(read_foreign(path))
