"""Writing .glb: what the file says, what comes back, and the same bytes for any chunks."""

from __future__ import annotations

import io
import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge._version import __version__
from flexgs_edge.errors import InputError
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.formats import FORMATS
from flexgs_edge.io.glb_writer import write_glb
from flexgs_edge.io.gltf import SPZ_EXTENSIONS
from flexgs_edge.io.reading import PLAIN, Writing
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import normalize_quats
from flexgs_edge.scene.source import MemorySource, Planes, SceneSource
from gltf_files import EXTENSION, glb_record
from synthetic import random_scene

HALF_SHORT = 0.51 / 32767


def written(source: SceneSource, path: Path) -> tuple[Planes, Planes]:
    """Values before and after, in the order of the file."""
    assert write_foreign(path, source) == ()
    back = read_foreign(path)
    assert back.notes == ()
    ours = source.select(near_order(source)).read(slice(0, source.count), list(FIELD))
    ours["quats"] = normalize_quats(ours["quats"])
    theirs = back.read(slice(0, back.count), list(FIELD))
    # Quaternions q and -q turn the same way.
    theirs["quats"] *= np.where((ours["quats"] * theirs["quats"]).sum(axis=0) < 0, np.float32(-1), np.float32(1))
    return ours, theirs


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("count", [1, 2, 257])
def test_round_trips(tmp_path: Path, degree: int, count: int) -> None:
    source = random_scene(count, seed=degree, degree=degree)
    ours, theirs = written(source, tmp_path / "a.glb")
    for name in ("means", "sh_dc", "sh_rest"):
        np.testing.assert_array_equal(theirs[name], ours[name], err_msg=name)
    np.testing.assert_allclose(theirs["log_scales"], ours["log_scales"], atol=2e-7)
    np.testing.assert_allclose(theirs["opacity_logits"], np.clip(ours["opacity_logits"], -7, 7), atol=5e-5)
    assert np.abs(theirs["quats"] - ours["quats"]).max() <= HALF_SHORT
    row_bytes = FORMATS[".glb"].row_bytes - 12 * (15 - source.width("sh_rest") // 3)
    assert 0 < (tmp_path / "a.glb").stat().st_size - count * row_bytes < 6000


def test_what_the_file_says(tmp_path: Path) -> None:
    source = random_scene(40, seed=1, degree=1)
    ours, _ = written(source, tmp_path / "a.glb")
    record = glb_record(tmp_path / "a.glb")
    assert record["asset"] == {"version": "2.0", "generator": f"flexgs-edge {__version__}"}
    assert record["extensionsUsed"] == [EXTENSION] and "extensionsRequired" not in record
    (primitive,) = record["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    assert primitive["extensions"] == {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}}
    names = [name.removeprefix(f"{EXTENSION}:") for name in primitive["attributes"]]
    assert names == [
        "POSITION", "COLOR_0", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0", *(f"SH_DEGREE_1_COEF_{n}" for n in range(3)),
    ]  # fmt: skip
    signs = np.array([[-1], [-1], [1]])
    bounds = record["accessors"][0]
    np.testing.assert_array_equal(bounds["min"], (ours["means"] * signs).min(axis=1))
    np.testing.assert_array_equal(bounds["max"], (ours["means"] * signs).max(axis=1))
    data = (tmp_path / "a.glb").read_bytes()
    start = 28 + struct.unpack_from("<I", data, 12)[0]
    view = record["bufferViews"][primitive["attributes"]["COLOR_0"]]
    colours = np.frombuffer(data, np.uint8, view["byteLength"], start + view["byteOffset"]).reshape(-1, 4).T
    exact = np.clip(ours["sh_dc"].astype(np.float64) * 0.28209479177387814 + 0.5, 0, 1) * 255
    assert np.abs(colours[:3] - exact).max() <= 0.5 + 1e-9
    opacities = 255 / (1 + np.exp(-ours["opacity_logits"][0].astype(np.float64)))
    assert np.abs(colours[3] - opacities).max() <= 0.5 + 1e-9
    assert start + sum(view["byteLength"] for view in record["bufferViews"]) == len(data)
    assert all(view["byteOffset"] % 4 == 0 for view in record["bufferViews"])


@pytest.mark.parametrize("degree", [0, 2])
def test_a_spz_inside(tmp_path: Path, degree: int) -> None:
    planes = random_scene(300, seed=6, degree=degree).read(slice(0, 300), list(FIELD))
    source = MemorySource(planes, origin=np.array([0, 7e5, 0]))
    writing = Writing(antialiased=True, glb="spz")
    assert write_foreign(tmp_path / "a.glb", source, writing=writing) == ()
    write_foreign(tmp_path / "plain.glb", source)
    write_foreign(tmp_path / "a.spz", MemorySource(planes), writing=writing)
    back, alone = read_foreign(tmp_path / "a.glb"), read_foreign(tmp_path / "a.spz")
    assert back.notes == () and dict(back.settings) == {"antialiased": True} and back.sh_degree == degree
    ours, theirs = alone.read(slice(0, 300), list(FIELD)), back.read(slice(0, 300), list(FIELD))
    theirs["means"] += (back.origin - source.origin).astype(np.float32)[:, None]
    for name in FIELD:
        np.testing.assert_array_equal(theirs[name], ours[name], err_msg=name)
    record = glb_record(tmp_path / "a.glb")
    extensions = [EXTENSION, SPZ_EXTENSIONS[0]]
    assert record["extensionsUsed"] == record["extensionsRequired"] == extensions
    (primitive,) = record["meshes"][0]["primitives"]
    assert primitive["extensions"][EXTENSION]["extensions"] == {SPZ_EXTENSIONS[0]: {"bufferView": 0}}
    assert not any("bufferView" in accessor for accessor in record["accessors"])
    assert len(primitive["attributes"]) == len(record["accessors"]) == 4 + (degree + 1) ** 2 - 1
    assert (tmp_path / "a.glb").stat().st_size < (tmp_path / "plain.glb").stat().st_size / 2
    assert (tmp_path / "a.glb").stat().st_size % 4 == 0


class InChunks(MemorySource):
    """A scene that is read in chunks of few rows, whatever is asked for."""

    most = 10**9

    def chunks(self, rows: int) -> Iterator[slice]:
        return super().chunks(min(rows, self.most))


def test_the_same_bytes_for_any_chunks() -> None:
    source = random_scene(100, seed=2, degree=2)
    chunked = InChunks(source.read(slice(0, 100), list(FIELD)))
    found = set()
    for chunked.most in (1, 7, 100):
        file = io.BytesIO()
        write_glb(file, chunked, PLAIN)
        found.add(file.getvalue())
    assert len(found) == 1


def test_extreme_values_stay_finite(tmp_path: Path) -> None:
    planes = random_scene(4, seed=3).read(slice(0, 4), list(FIELD))
    planes["log_scales"][0] = [-1e30, -150, 150, 1e30]
    planes["opacity_logits"][0] = [-1e30, -100, 100, 1e30]
    planes["sh_dc"][:, 0] = [-1e10, 1e10, 0]
    ours, theirs = written(MemorySource(planes), tmp_path / "a.glb")
    assert np.isfinite(theirs["log_scales"]).all()
    order = np.argsort(ours["log_scales"][0], kind="stable")
    limits = np.finfo(np.float32)
    expected = np.log([limits.tiny, limits.tiny, limits.max, limits.max], dtype=np.float64)
    np.testing.assert_allclose(theirs["log_scales"][0][order], expected, atol=1e-4)
    order = np.argsort(ours["opacity_logits"][0], kind="stable")
    # Opacities of 0 and 1 are what they are; `check_scene` gives them finite logits.
    np.testing.assert_allclose(theirs["opacity_logits"][0][order], [-np.inf, -100, np.inf, np.inf], atol=0.1)


class Endless(MemorySource):
    """A scene of more Gaussians than a .glb holds; only their number is asked."""

    def chunks(self, rows: int) -> Iterator[slice]:
        yield slice(0, 1)


def test_more_than_four_gigabytes_are_refused() -> None:
    source = Endless(random_scene(1, degree=3).read(slice(0, 1), list(FIELD)))
    source.count = 20_000_000
    file = io.BytesIO()
    with pytest.raises(InputError, match="20000000 Gaussians need 46400[0-9]* bytes as .glb, which holds 4294967295"):
        write_glb(file, source, PLAIN)
    assert file.getvalue() == b""
