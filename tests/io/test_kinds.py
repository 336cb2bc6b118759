"""What a file is, by its first bytes."""

from __future__ import annotations

import gzip
import json
import zipfile
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.codec.sections import MAGIC
from flexgs_edge.errors import InputError
from flexgs_edge.io.kinds import Kind, kind_of
from scene_files import header, property_names, random_rows, write_rows

POINTS = np.zeros(4, [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1")])
FACES = "element face 2\nproperty list uchar int vertex_indices"
PLY = header(random_rows(2)) + random_rows(2).tobytes()
PACKED = np.zeros(2, [("packed_position", "<i4"), ("packed_rotation", "<i4")])


def told(folder: Path, data: bytes) -> Kind | None:
    (folder / "a").write_bytes(data)
    return kind_of(folder / "a", "a")


def zipped(folder: Path, *names: str) -> bytes:
    with zipfile.ZipFile(folder / "z", "w") as archive:
        for name in names:
            archive.writestr(name, "{}")
    return (folder / "z").read_bytes()


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"", "an empty file"),
        (b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 123\n", "a Git LFS pointer of 123 bytes"),
        (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer, not the file itself"),
        (b"\n <!DOCTYPE html>\n<html>", "an HTML page"),
        (b"\xef\xbb\xbf<html lang=de>", "an HTML page"),
        (b'<?xml version="1.0"?><Error><Code>NoSuchKey', "an XML text"),
        (header(POINTS) + POINTS.tobytes(), "a point cloud of 4 points, not Gaussians"),
        (header(POINTS, extra=FACES), "a mesh with 2 faces, not Gaussians"),
        (header(random_rows(1, names=[n for n in property_names(0) if n != "scale_2"])), "a PLY of 2D Gaussian splats"),
        (
            header(random_rows(1, names=[*property_names(0), "t", "scale_t", "rot_r_0"])),
            "a PLY of Gaussians that move (4D",
        ),
        (header(random_rows(1, names=[*property_names(0), "motion_0"])), "a PLY of Gaussians that move (4D: motion_0)"),
        (b"\x89PNG\r\n\x1a\n0000", "a PNG image"),
        (b"\xff\xd8\xff\xe0", "a JPEG image"),
        (b"RIFF0000WEBPVP8L", "a WebP image"),
        (b"\x93NUMPY\x01\x00", "a NumPy array"),
        (gzip.compress(b"something", mtime=0), "a gzip file"),
        (b"\x1f\x8b\x08", "a gzip file"),
        (b"PK\x03\x04 cut", "a zip archive"),
        (b'[{"id": 0, "img_name": "a"}]', "a file of cameras"),
        (b'{"frames": [{"transform_matrix": []}]}', "a file of cameras"),
        (b'{"a": 1}', "a JSON file"),
    ],
)
def test_files_that_hold_no_scene(tmp_path: Path, data: bytes, words: str) -> None:
    found = told(tmp_path, data)
    assert found is not None and found.words.startswith(words) and found.suffix is None
    assert len(found.advice) > 15 and str(found.refused("a.ply")) == f"a.ply: this is {found.words}: {found.advice}"


@pytest.mark.parametrize(
    ("data", "suffix"),
    [
        (PLY, ".ply"),
        (PLY.replace(b"\n", b"\r\n", 9), ".ply"),
        (b"ply\nnonsense", ".ply"),
        (header(random_rows(1, names=["x", "f_dc_0"])), ".ply"),
        (header(PACKED) + PACKED.tobytes(), ".compressed.ply"),
        (MAGIC + b"\2\0", ".fgs"),
        (b"NGSP\4\0\0\0", ".spz"),
        (gzip.compress(b"NGSP\3\0\0\0" + bytes(900), mtime=0), ".spz"),
        (gzip.compress(PLY, mtime=0), ".ply.gz"),
        (b"glTF\2\0\0\0", ".glb"),
        (json.dumps({"asset": {"version": "2.0"}, "buffers": []}).encode(), ".gltf"),
    ],
)
def test_scenes(tmp_path: Path, data: bytes, suffix: str) -> None:
    found = told(tmp_path, data)
    assert found is not None and found.suffix == suffix


def test_zip_archives(tmp_path: Path) -> None:
    for names, suffix, words in (
        (("meta.json", "means_l.webp"), ".sog", "a .sog file"),
        (("logo/meta.json",), ".sog", "a .sog file"),
        (("a/data.pkl", "a/data/0"), None, "a PyTorch checkpoint"),
        (("means.npy",), None, "a NumPy archive"),
        (("scene.ply",), None, "a zip archive"),
    ):
        found = told(tmp_path, zipped(tmp_path, *names))
        assert found is not None and (found.suffix, found.words) == (suffix, words)


@pytest.mark.parametrize("data", [b"polygon", b"plywood", bytes(64), b"\1", b"hello, this is a text", b"[1, 2]"])
def test_files_that_do_not_tell(tmp_path: Path, data: bytes) -> None:
    assert told(tmp_path, data) is None


def test_a_splat_file_is_never_told(tmp_path: Path) -> None:
    """Not even if the low bytes of its first coordinate are the first ones of gzip or JPEG."""
    for low in (b"\x1f\x8b", b"\xff\xd8\xff"):
        assert told(tmp_path, low + bytes([0x8C] * (3 - len(low))) + b"\x3f" + bytes(28)) is None
    rng = np.random.default_rng(0)
    for _ in range(300):
        data = np.zeros(4, [("place", "<f4", 6), ("bytes", "u1", 8)])
        data["place"], data["bytes"] = rng.normal(size=(4, 6)), rng.integers(0, 256, (4, 8))
        assert told(tmp_path, data.tobytes()) is None


@pytest.mark.parametrize(
    ("name", "renamed"),
    [
        ("a/b.ply", "b.spz"),
        ("b.compressed.ply", "b.spz"),
        ("b", "b.spz"),
        ("b.c.xyz", "b.c.spz"),
        (".ply", "scene.spz"),
    ],
)
def test_the_name_that_a_file_should_have(name: str, renamed: str) -> None:
    error = Kind("a .spz file", suffix=".spz").renamed(name, [".ply", ".compressed.ply", ".sog"])
    assert str(error) == f"{name}: this is a .spz file: rename it to {renamed}"


def test_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="the user's name: cannot read it"):
        kind_of(tmp_path, "the user's name")


def test_files_of_other_programs(wild: Path) -> None:
    found = {place.name: kind_of(place, place.name) for place in wild.iterdir() if place.is_file()}
    told = {name: kind.suffix or kind.words for name, kind in found.items() if kind is not None}
    assert told.pop("lfs-pointer.ply").startswith("a Git LFS pointer of 66061086 bytes")
    assert told.pop("brush-init.ply") == "a point cloud of 100 points, not Gaussians"
    assert told.pop("lg-cube_att.ply") == "a mesh with 12 faces, not Gaussians"
    assert told.pop("ms-beetle.ascii.ply") == "a mesh with 2053 faces, not Gaussians"
    for name, suffix in told.items():
        assert name.endswith(suffix), (name, suffix)
    assert set(found) - set(told) >= {"st-minimal.splat", "ms-train3.splat", "st-minimal.ksplat"}
    assert len(told) > 12


def test_every_prefix_of_a_file_is_told_quickly(tmp_path: Path) -> None:
    """Truncated files of every kind raise nothing else than errors of ours."""
    for data in (PLY, gzip.compress(PLY), zipped(tmp_path, "meta.json", "b"), b'{"asset": {}, "nodes": []}', b"<html>"):
        for length in range(0, len(data), 7):
            told(tmp_path, data[:length])
            changed = bytearray(data)
            changed[length] ^= 64
            told(tmp_path, bytes(changed))


def test_a_point_cloud_is_refused_by_the_right_words(tmp_path: Path) -> None:
    found = kind_of(write_rows(tmp_path / "a.ply", POINTS), "a.ply")
    assert found is not None
    assert str(found.refused("a.ply")).endswith("not Gaussians: train a scene first, and give its output")


def test_scenes_of_xgrids_are_named(tmp_path: Path) -> None:
    (tmp_path / "a.lcc").write_text('{"version": "5.0", "totalSplats": 3}')
    found = kind_of(tmp_path / "a.lcc", "a.lcc")
    assert found is not None and found.words.startswith("a scene of XGRIDS") and "splat-transform" in found.advice
