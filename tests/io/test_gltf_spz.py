"""A .spz inside of a .glb: its axes, its marks, and where the file has it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.io.decoded import DecodedSource
from flexgs_edge.io.frames import RUB, Frame
from flexgs_edge.io.gltf import read_gltf
from flexgs_edge.io.reading import AS_WRITTEN
from flexgs_edge.scene.source import Rows
from gltf_files import EXTENSION, GltfBuilder, own, planes, splat_arrays


@pytest.fixture
def builder() -> GltfBuilder:
    return GltfBuilder()


class Spz(DecodedSource):
    """Stands for the reader of `.spz`: three rows that tell their axes apart."""

    def __init__(self, data: bytes, name: str, frame: Frame | None = None, antialiased: bool = False) -> None:
        super().__init__(name, 3, 1, len(data))
        self.data, self.frame = data, frame
        self.settings = {"antialiased": antialiased}

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        values = np.arange(3 * 9.0).reshape(9, 3) + 1
        values = values[: self.width(field)] if field != "means" else values[:3] * 1.5
        return values[:, rows]


def spz_file(builder: GltfBuilder, bounds: list[list[float]] | None, place: str = "inner") -> None:
    """A primitive whose values are in a buffer view, as in the extension's own example."""
    view = builder.view(b"SPZ bytes")
    builder.record["accessors"].append({"componentType": 5126, "count": 3, "type": "VEC3"})
    if bounds:
        builder.record["accessors"][-1] |= {"min": bounds[0], "max": bounds[1]}
    primitive = builder.primitive({"POSITION": len(builder.record["accessors"]) - 1})
    word = "KHR_gaussian_splatting_compression_spz_2"
    if place == "inner":
        primitive["extensions"][EXTENSION] = {"extensions": {word: {"bufferView": view}}}
    else:
        primitive["extensions"] = {"KHR_spz_gaussian_splats_compression": {"bufferView": view}}
    builder.node(mesh=builder.mesh(primitive), translation=[0, 0, 100])


@pytest.mark.parametrize("place", ["inner", "outer"])
@pytest.mark.parametrize(
    ("bounds", "frame", "signs"),
    [
        (None, None, (-1, 1, -1)),
        ([[-4.5, 6, -13.5], [-1.5, 9, -10.5]], None, (-1, 1, -1)),
        ([[1.5, 6, 10.5], [4.5, 9, 13.5]], None, (1, 1, 1)),
        ([[1.5, 6, 10.5], [4.5, 9, 13.5]], RUB, (-1, 1, -1)),
    ],
)
def test_spz_is_turned_to_gltfs_axes(
    builder: GltfBuilder,
    tmp_path: Path,
    place: str,
    bounds: list[list[float]] | None,
    frame: Frame | None,
    signs: tuple[int, int, int],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    spz_file(builder, bounds, place)
    path = builder.glb(tmp_path / "a.glb")
    seen: list[tuple[bytes, str]] = []

    def unpack(data: bytes, name: str) -> DecodedSource:
        seen.append((data, name))
        return Spz(data, name, frame, antialiased=True)

    monkeypatch.setattr("flexgs_edge.io.spz.spz_source", unpack)
    source = read_gltf(path, "user.glb", AS_WRITTEN)
    assert seen == [(b"SPZ bytes", "user.glb: meshes[0].primitives[0]: the .spz in bufferViews[0]")]
    assert (source.count, source.sh_degree, dict(source.settings)) == (3, 1, {"antialiased": True})
    raw = Spz(b"", "")
    means = raw.decode(slice(0, 3), "means") * np.array(signs)[:, None]
    np.testing.assert_allclose(
        planes(source)["means"] + source.origin[:, None], means + np.array([[0], [0], [100]]), atol=1e-5
    )
    # y is odd in y alone, z in z, x in x.
    odd = np.array([signs[1], signs[2], signs[0]] * 3)[:, None]
    np.testing.assert_allclose(planes(source)["sh_rest"], raw.decode(slice(0, 3), "sh_rest") * odd)


def test_marks_of_some_parts_are_a_note(builder: GltfBuilder, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spz_file(builder, None)
    builder.splats(splat_arrays(2))
    monkeypatch.setattr("flexgs_edge.io.spz.spz_source", lambda data, name: Spz(data, name, None, True))
    source = read_gltf(builder.glb(tmp_path / "a.glb"), "a.glb", AS_WRITTEN)
    assert (source.count, dict(source.settings)) == (5, {})
    assert source.notes[-1].startswith("some parts say that they are antialiased")


def test_a_spz_inside(wild: Path) -> None:
    pytest.importorskip("flexgs_edge.io.spz")
    source = own(wild / "cesium-spz-basic.glb")
    # The file states positions that are those of its .spz as they are; the node turns y and z.
    np.testing.assert_allclose(planes(source)["means"], [[1], [3], [-2]], atol=1e-6)
