"""Reading splats from .glb and .gltf: accessors, buffers, drafts of the extension, SPZ, and what is refused."""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FlexGSError, FormatError, InputError
from flexgs_edge.io.decoded import DecodedSource
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.frames import RUB, Frame
from flexgs_edge.io.gltf import read_gltf, splats_of
from flexgs_edge.io.gltf_container import GltfFile
from flexgs_edge.io.reading import AS_WRITTEN
from flexgs_edge.run.open_scene import open_scene
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import Planes, Rows, SceneSource
from gltf_files import EXTENSION, GltfBuilder, splat_arrays


def own(path: Path) -> SceneSource:
    """A file's scene in its own frame."""
    return read_gltf(path, str(path), AS_WRITTEN)


def planes(source: SceneSource) -> Planes:
    return source.read(slice(0, source.count), list(FIELD))


def expected(arrays: dict[str, np.ndarray], degree: int = 0) -> Planes:
    """What the attributes of `splat_arrays` mean."""
    wide = {name: values.astype(np.float64).T for name, values in arrays.items()}
    rest = [wide[f"SH_DEGREE_{band}_COEF_{n}"] for band in range(1, degree + 1) for n in range(2 * band + 1)]
    count = wide["POSITION"].shape[1]
    return {
        "means": wide["POSITION"],
        "sh_dc": wide["SH_DEGREE_0_COEF_0"],
        "sh_rest": np.stack(rest, axis=1).reshape(-1, count) if rest else np.zeros((0, count)),
        "opacity_logits": np.log(wide["OPACITY"] / (1 - wide["OPACITY"])),
        "log_scales": np.log(wide["SCALE"]),
        "quats": wide["ROTATION"][[3, 0, 1, 2]],
    }


def assert_planes(found: Planes, wanted: Planes, atol: float = 1e-6) -> None:
    for name, values in wanted.items():
        np.testing.assert_allclose(found[name], values, atol=atol, err_msg=name)


@pytest.fixture
def builder() -> GltfBuilder:
    return GltfBuilder()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_values_of_a_ratified_file(builder: GltfBuilder, tmp_path: Path, degree: int) -> None:
    arrays = splat_arrays(5, degree)
    builder.splats(arrays)
    for path in (builder.glb(tmp_path / "a.glb"), builder.gltf(tmp_path / "a.gltf")):
        source = own(path)
        assert (source.count, source.sh_degree, source.notes, source.name) == (5, degree, (), str(path))
        assert source.held_bytes == 4 * 5 * (14 + source.width("sh_rest"))
        assert_planes(planes(source), expected(arrays, degree))
        path.unlink()  # everything is in memory
        assert_planes(planes(source), expected(arrays, degree))


def test_axes_become_those_of_the_program(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(5, 3)
    builder.splats(arrays)
    source = read_foreign(builder.glb(tmp_path / "a.glb"))
    found, wanted = planes(source), expected(arrays, 3)
    np.testing.assert_allclose(found["means"], wanted["means"] * [[-1], [-1], [1]], atol=1e-6)
    np.testing.assert_allclose(found["sh_rest"][0], -wanted["sh_rest"][0], atol=1e-6)
    np.testing.assert_allclose(found["sh_rest"][1], wanted["sh_rest"][1], atol=1e-6)


def test_rows_in_any_order_are_those_of_the_whole(builder: GltfBuilder, tmp_path: Path) -> None:
    for seed in range(3):
        builder.splats(splat_arrays(40, 2 if seed == 1 else 0, seed), scale=[1, 2, 3 - seed], rotation=[0, 0.6, 0, 0.8])
    source = own(builder.glb(tmp_path / "a.glb"))
    assert (source.count, source.sh_degree) == (120, 2)
    whole = planes(source)
    assert (
        not whole["sh_rest"][:, :40].any() and whole["sh_rest"][:, 40:80].any() and not whole["sh_rest"][:, 80:].any()
    )
    rows: Rows
    for rows in (slice(37, 83), np.array([0, 39, 40, 41, 79, 80, 119]), slice(50, 50), slice(79, 80)):
        for name, values in source.read(rows, list(FIELD)).items():
            np.testing.assert_array_equal(values, whole[name][:, rows], err_msg=name)


NARROW = [
    ("ROTATION", np.array([[127, 0, 0, 0], [-128, 0, 127, 3]], np.int8), True, 127),
    ("ROTATION", np.array([[32767, 0, 0, 0], [-32768, 0, 5, 3]], np.int16), True, 32767),
    ("SCALE", np.array([[1, 2, 255], [3, 3, 3]], np.uint8), False, 1),
    ("SCALE", np.array([[1, 2, 255], [3, 3, 3]], np.uint8), True, 255),
    ("SCALE", np.array([[1, 2, 65535], [3, 3, 3]], np.uint16), False, 1),
    ("SCALE", np.array([[1, 2, 65535], [3, 3, 3]], np.uint16), True, 65535),
    ("OPACITY", np.array([[1], [254]], np.uint8), True, 255),
    ("OPACITY", np.array([[600], [65000]], np.uint16), True, 65535),
    ("POSITION", np.array([[-128, 1, 2], [3, 4, 5]], np.int8), False, 1),
    ("POSITION", np.array([[-127, 1, 2], [3, 4, 5]], np.int8), True, 127),
    ("POSITION", np.array([[200, 1, 2], [3, 4, 5]], np.uint16), False, 1),
    ("POSITION", np.array([[200, 1, 2], [3, 4, 5]], np.uint8), True, 255),
    ("SH_DEGREE_0_COEF_0", np.array([[-127, 1, 2], [3, 4, 5]], np.int8), True, 127),
]


@pytest.mark.parametrize(("name", "values", "normalized", "most"), NARROW)
@pytest.mark.parametrize("stride", [0, 12])
def test_whole_numbers(
    builder: GltfBuilder, tmp_path: Path, name: str, values: np.ndarray, normalized: bool, most: int, stride: int
) -> None:
    arrays = splat_arrays(2)
    accessors = {key: builder.accessor(array) for key, array in arrays.items() if key != name}
    accessors[name] = builder.accessor(values, stride, **({"normalized": True} if normalized else {}))
    builder.node(mesh=builder.mesh(builder.primitive(accessors)))
    arrays[name] = np.maximum(values / most, -1.0 if normalized else -np.inf)
    source = own(builder.glb(tmp_path / "a.glb"))
    assert source.notes == ()
    assert_planes(planes(source), expected(arrays))


def test_interleaved_and_sparse_accessors(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(7)
    table = np.concatenate([arrays["POSITION"], arrays["SCALE"]], axis=1)
    view = builder.view(table.tobytes(), byteStride=24)
    for offset in (0, 12):
        builder.record["accessors"].append(
            {"bufferView": view, "byteOffset": offset, "componentType": 5126, "count": 7, "type": "VEC3"}
        )
    accessors = {"POSITION": 0, "SCALE": 1}
    accessors |= {name: builder.accessor(values) for name, values in arrays.items() if name not in accessors}
    sparse = {
        "count": 2,
        "indices": {"bufferView": builder.view(np.array([1, 6], np.uint16).tobytes()), "componentType": 5123},
        "values": {"bufferView": builder.view(np.array([[9, 8, 7], [6, 5, 4]], np.float32).tobytes())},
    }
    builder.record["accessors"][0]["sparse"] = sparse
    builder.record["accessors"].append({"componentType": 5126, "count": 7, "type": "VEC3", "sparse": sparse})
    accessors["SH_DEGREE_0_COEF_0"] = len(builder.record["accessors"]) - 1
    builder.node(mesh=builder.mesh(builder.primitive(accessors)))
    found = planes(own(builder.glb(tmp_path / "a.glb")))
    arrays["POSITION"][[1, 6]] = [[9, 8, 7], [6, 5, 4]]
    arrays["SH_DEGREE_0_COEF_0"] = np.zeros((7, 3), np.float32)
    arrays["SH_DEGREE_0_COEF_0"][[1, 6]] = [[9, 8, 7], [6, 5, 4]]
    assert_planes(found, expected(arrays))


def test_buffers_beside_the_file(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(3)
    builder.splats(arrays)
    (tmp_path / "in").mkdir()
    path = builder.gltf(tmp_path / "in" / "a.gltf", "the%20values.bin")
    assert_planes(planes(own(path)), expected(arrays))
    # A packed .gltf is unpacked elsewhere; its buffer still lies beside the user's file.
    (tmp_path / "in" / "b.gltf.gz").write_bytes(gzip.compress(path.read_bytes()))
    assert open_scene(tmp_path / "in" / "b.gltf.gz").count == 3
    (tmp_path / "outside.bin").write_bytes(builder.data)
    (tmp_path / "in" / "link.bin").symlink_to(tmp_path / "outside.bin")
    for uri, message in {
        "../outside.bin": "expected a file in the folder of the scene",
        "%2e%2e/outside.bin": "expected a file in the folder of the scene",
        str(tmp_path / "outside.bin"): "expected a file in the folder of the scene",
        "link.bin": "expected a file in the folder of the scene",
        "http://localhost/a.bin": "expected the name of a file beside the scene, or a data URI",
        "file:///etc/passwd": "expected the name of a file beside the scene, or a data URI",
        "none.bin": "no file 'none.bin' beside it",
        "a\0b": "expected the name of a file beside the scene",
        "\ud800": "expected the name of a file beside the scene",
        "x" * 5000: "a file",
        "": "no file '' beside it",
        "data:text/plain,abc": "expected a data URI in base64",
        "data:;base64,ab=c": "not base64",
        "data:;base64,YWJj": "but 3 bytes are there",
    }.items():
        builder.gltf(path, "in.bin")
        path.write_text(path.read_text().replace('"in.bin"', json.dumps(uri)))
        with pytest.raises(InputError, match=message):
            own(path)


def test_scales_of_drafts_are_logarithms(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(300)
    linear = arrays["SCALE"]
    note = "scales are logarithms, as in drafts of the extension"
    for scales, read_as, noted in (
        (np.log(linear), np.log(linear), True),
        (np.array([[1, 2, 3]] * 300, np.int8), np.array([[1, 2, 3]] * 300), True),
        (np.zeros((300, 3), np.float32), np.zeros((300, 3)), True),
        (linear, np.log(linear), False),
    ):
        made = GltfBuilder()
        made.splats(arrays | {"SCALE": scales})
        source = own(made.glb(tmp_path / "a.glb"))
        assert source.notes == ((note,) if noted else ())
        np.testing.assert_allclose(planes(source)["log_scales"], read_as.T, atol=1e-6)
    # One damaged value makes no draft: its row is reported.
    linear[7, 1] = -1
    builder.splats(arrays)
    with pytest.raises(InputError, match=r"1 of 300 Gaussians are invalid.*log_scales in 1 \(first row 7\)"):
        check_scene(own(builder.glb(tmp_path / "a.glb")))


def test_colours_in_place_of_missing_attributes(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(2)
    del arrays["SH_DEGREE_0_COEF_0"], arrays["OPACITY"]
    accessors = {name: builder.accessor(values) for name, values in arrays.items()}
    colours = np.array([[0, 255, 51, 102], [255, 0, 0, 204]], np.uint8)
    accessors["COLOR_0"] = builder.accessor(colours, normalized=True)
    builder.node(mesh=builder.mesh(builder.primitive(accessors)))
    source = own(builder.glb(tmp_path / "a.glb"))
    found = planes(source)
    np.testing.assert_allclose(found["sh_dc"] * SH_C0 + 0.5, colours.T[:3] / 255, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found["opacity_logits"])), colours.T[3:] / 255, atol=1e-6)
    assert source.notes == tuple(
        f"{name} is missing: COLOR_0 taken in its place" for name in ("SH_DEGREE_0_COEF_0", "OPACITY")
    )


def test_names_of_early_drafts(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(2)
    primitive = builder.splats(arrays)
    primitive["attributes"] = {
        name.replace(f"{EXTENSION}:", "_"): index for name, index in primitive["attributes"].items()
    }
    assert_planes(planes(own(builder.glb(tmp_path / "a.glb"))), expected(arrays))


def test_incomplete_sh_are_left_out_with_a_note(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(2, 2)
    del arrays["SH_DEGREE_2_COEF_3"]
    builder.splats(arrays)
    source = own(builder.glb(tmp_path / "a.glb"))
    assert source.sh_degree == 1
    assert source.notes == ("SH above degree 1 left out: they are incomplete, or of a degree above 3",)
    assert_planes(planes(source), expected(arrays, 1))


def test_notes_on_what_we_draw_otherwise(builder: GltfBuilder, tmp_path: Path) -> None:
    arrays = splat_arrays(2)
    accessors = {name: builder.accessor(values) for name, values in arrays.items()}
    odd = builder.primitive(
        accessors, kernel="box", projection="fisheye", sortingMethod="none", colorSpace="lin_rec709_display",
        extensions={"EXT_gaussian_splatting_kernel_box": {}},
    )  # fmt: skip
    del odd["mode"]
    points = {"attributes": {"POSITION": accessors["POSITION"]}, "mode": 0}
    builder.node(mesh=builder.mesh(odd, points), skin=0)
    builder.node(mesh=builder.mesh(points | {"mode": 4}))
    builder.record["animations"] = [{}]
    path = builder.glb(tmp_path / "a.glb")
    path.write_bytes(path.read_bytes() + b"more")
    assert own(path).notes == (
        "4 bytes behind the data ignored",
        "splats whose mode is not POINTS are read as points",
        "kernel 'box' is drawn as ellipse",
        "projection 'fisheye' is drawn as perspective",
        "sortingMethod 'none' is drawn as cameraDistance",
        "colours in 'lin_rec709_display' are kept as they are, and drawn as sRGB",
        "extension 'EXT_gaussian_splatting_kernel_box' ignored",
        "skins left out",
        "2 meshes or point clouds that are no splats left out",
        "animations left out",
    )


def test_what_holds_no_gaussians(builder: GltfBuilder, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    positions = {"attributes": {"POSITION": builder.accessor(np.zeros((3, 3), np.float32))}}
    with pytest.raises(InputError, match="a.glb: holds a glTF without meshes, not Gaussians"):
        own(builder.glb(path))
    builder.node(mesh=builder.mesh(positions))
    with pytest.raises(InputError, match="a.glb: holds a mesh, not Gaussians: expected a primitive with KHR_gaussian"):
        own(builder.glb(path))
    builder.record["meshes"][0]["primitives"][0]["mode"] = 0
    with pytest.raises(InputError, match="holds a point cloud, not Gaussians"):
        own(builder.glb(path))
    builder.mesh(builder.primitive({}))
    with pytest.raises(InputError, match="its splats are in no node of the scene that it shows"):
        own(builder.glb(path))


def test_extensions_that_we_do_not_know(builder: GltfBuilder, tmp_path: Path) -> None:
    builder.splats(splat_arrays(2))
    path = tmp_path / "a.glb"
    builder.record["extensionsRequired"] = [EXTENSION, "KHR_mesh_quantization", "KHR_materials_unlit"]
    assert own(builder.glb(path)).count == 2
    builder.record["extensionsRequired"] += ["EXT_meshopt_compression", "XYZ_splats"]
    with pytest.raises(
        InputError, match="a.glb: needs extensions that we do not know: 'EXT_meshopt_compression', 'XYZ_"
    ):
        own(builder.glb(path))
    del builder.record["extensionsRequired"]
    builder.record["nodes"][0]["extensions"] = {"EXT_mesh_gpu_instancing": {"attributes": {}}}
    with pytest.raises(InputError, match=r"nodes\[0\]: EXT_mesh_gpu_instancing shows splats many times"):
        own(builder.glb(path))


Change = tuple[str, str, Any, str]
BROKEN: list[Change] = [
    ("accessors.0", "count", 10**9, "needs 12000000000 bytes of bufferViews.0., which has 24; is it complete"),
    ("accessors.0", "count", -1, "accessors.0.: count: expected a whole number, 0 or more, found -1"),
    ("accessors.0", "count", 1.5, "count: expected a whole number"),
    ("accessors.0", "count", 1, "SCALE: expected as many rows as POSITION has, 1, found 2|expected as many rows"),
    ("accessors.0", "byteOffset", 4, "needs 28 bytes of bufferViews"),
    ("accessors.0", "componentType", 5125, "componentType: expected 5120 to 5123 or 5126, found 5125"),
    ("accessors.0", "componentType", True, "componentType: expected a whole number"),
    ("accessors.0", "type", "VEC9", "type: expected SCALAR, VEC2, VEC3 or VEC4, found 'VEC9'"),
    ("accessors.0", "type", "VEC2", "POSITION: expected numbers in 3 columns, found 2"),
    ("accessors.0", "normalized", True, "normalized: expected false for floats"),
    ("accessors.0", "normalized", 1, "normalized: expected true or false, found 1"),
    ("accessors.0", "bufferView", 99, r"refers to bufferViews\[99\], but the file has 5 bufferViews"),
    ("accessors.0", "bufferView", None, "has no bufferView: an extension that we do not know may hold its values"),
    ("bufferViews.0", "byteLength", 10**6, "ends at byte 1000000 of a buffer of"),
    ("bufferViews.0", "byteOffset", 10**6, "ends at byte 1000024 of a buffer of"),
    ("bufferViews.0", "byteStride", 8, "rows of 12 bytes in bufferViews.0., whose byteStride is 8"),
    ("bufferViews.0", "byteStride", 4096, "byteStride: expected at most 252, found 4096"),
    ("bufferViews.0", "buffer", 1, r"bufferViews\[0\]: refers to buffers\[1\], but the file has 1 buffers"),
    ("nodes.0", "mesh", 3, r"nodes\[0\]: refers to meshes\[3\], but the file has 1 meshes"),
    ("nodes.0", "children", [0], r"nodes\[0\]: nodes\[0\] has two parents"),
    ("nodes.0", "children", "x", "children: expected a list, found 'x'"),
    ("nodes.0", "rotation", [0, 0, 0, 0], "rotation: expected a quaternion that is not zero"),
    ("nodes.0", "rotation", [0, 0, 1], "rotation: expected a list of 4 finite numbers"),
    ("nodes.0", "scale", [1, 1, float("nan")], "scale: expected a list of 3 finite numbers, found nan"),
    ("nodes.0", "translation", [10**400, 0, 0], "translation: expected a list of 3 finite numbers"),
    ("scenes.0", "nodes", [7], r"scenes\[0\]: refers to nodes\[7\], but the file has 1 nodes"),
    ("", "scene", 4, r"scene: refers to scenes\[4\], but the file has 1 scenes"),
    ("asset", "version", "1.0", "asset.version: expected 2.0, found '1.0'"),
    ("", "accessors", {}, "accessors: expected a list"),
    ("", "nodes", [7], "nodes.0.: expected an object, found 7"),
]


@pytest.mark.parametrize(("place", "key", "value", "message"), BROKEN)
def test_claims_that_the_bytes_do_not_bear(
    builder: GltfBuilder, tmp_path: Path, place: str, key: str, value: object, message: str
) -> None:
    builder.splats(splat_arrays(2))
    target: Any = builder.record
    for step in place.split(".") if place else ():
        target = target[int(step) if step.isdigit() else step]
    target[key] = value
    path = builder.glb(tmp_path / "a.glb")
    with pytest.raises(FormatError, match=message) as caught:
        own(path)
    assert str(path) in str(caught.value)


def test_missing_attributes(tmp_path: Path) -> None:
    for name in ("POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"):
        builder = GltfBuilder()
        arrays = splat_arrays(2)
        del arrays[name]
        builder.splats(arrays)
        with pytest.raises(FormatError, match=f"attributes: missing {name}; found "):
            own(builder.glb(tmp_path / "a.glb"))


def test_files_cut_anywhere(builder: GltfBuilder, tmp_path: Path) -> None:
    builder.splats(splat_arrays(1))
    for path in (builder.glb(tmp_path / "a.glb"), builder.gltf(tmp_path / "a.gltf")):
        whole = path.read_bytes()
        for length in [*range(64), *range(64, len(whole), 23), len(whole) - 1]:
            path.write_bytes(whole[:length])
            with pytest.raises(FormatError) as caught:
                own(path)
            assert str(path) in str(caught.value)
        for at in range(min(20, len(whole))):  # each byte of the header
            path.write_bytes(whole[:at] + bytes([whole[at] ^ 0xFF]) + whole[at + 1 :])
            with pytest.raises(FlexGSError):
                own(path)


def test_empty_scenes_and_zeros_without_bytes(builder: GltfBuilder, tmp_path: Path) -> None:
    path = tmp_path / "a.glb"
    builder.splats(splat_arrays(0))
    source = own(builder.glb(path))
    assert source.count == 0
    with pytest.raises(InputError, match="the scene is empty"):
        check_scene(source)
    builder.splats(splat_arrays(2))
    accessor = builder.record["accessors"][5]
    del accessor["bufferView"]
    accessor |= {"count": 10**12, "sparse": {"count": 0}}
    with pytest.raises(
        FormatError, match=r"accessors\[5\]: count: expected a number that a file of \d+ bytes may have"
    ):
        own(builder.glb(path))


def test_nodes_cannot_show_more_than_the_bytes_bear(builder: GltfBuilder, tmp_path: Path) -> None:
    builder.splats(splat_arrays(2000))
    for _ in range(1500):
        builder.node(mesh=0)
    with pytest.raises(FormatError, match=r"a.glb: shows more than \d+ Gaussians, but has \d+ bytes"):
        own(builder.glb(tmp_path / "a.glb"))


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
) -> None:
    spz_file(builder, bounds, place)
    path = builder.glb(tmp_path / "a.glb")
    seen: list[tuple[bytes, str]] = []

    def unpack(data: bytes, name: str) -> DecodedSource:
        seen.append((data, name))
        return Spz(data, name, frame, antialiased=True)

    source = splats_of(GltfFile(path, "user.glb"), unpack)
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


def test_marks_of_some_parts_are_a_note(builder: GltfBuilder, tmp_path: Path) -> None:
    spz_file(builder, None)
    builder.splats(splat_arrays(2))
    source = splats_of(
        GltfFile(builder.glb(tmp_path / "a.glb"), "a.glb"), lambda data, name: Spz(data, name, None, True)
    )
    assert (source.count, dict(source.settings)) == (5, {})
    assert source.notes[-1].startswith("some parts say that they are antialiased")


@pytest.mark.parametrize("name", ["bevy-khr_conformance_matrix.glb", "bevy-khr_conformance_matrix.gltf"])
def test_the_conformance_file_of_a_draft(wild: Path, name: str) -> None:
    source = own(wild / name)
    assert (source.count, source.sh_degree) == (15, 3)
    assert source.notes == (
        "colours in 'lin_rec709_display' are kept as they are, and drawn as sRGB",
        "scales are logarithms, as in drafts of the extension",
    )
    found = planes(source)
    np.testing.assert_array_equal(found["means"], np.repeat([[1.0], [2.0], [3.0]], 15, axis=1))
    np.testing.assert_array_equal(found["quats"], np.repeat([[0.0], [1.0], [0.0], [0.0]], 15, axis=1))
    np.testing.assert_allclose(found["log_scales"][:, 4:8].T, [[1, -2, 3], [1, 0, -1], [2, -3, 4], [1, 0, -1]])
    np.testing.assert_allclose(found["sh_rest"][:15, 14], np.arange(1, 16) + 0.1, atol=1e-6)
    np.testing.assert_allclose(1 / (1 + np.exp(-found["opacity_logits"][0, 8:11])), [0.75, 64 / 255, 0.25], atol=1e-4)


def test_a_kernel_of_an_unknown_extension(wild: Path) -> None:
    source = own(wild / "bevy-khr_extensible_fallback.gltf")
    assert source.count == 1 and len(source.notes) == 5
    np.testing.assert_allclose(planes(source)["log_scales"], 0)


def test_a_spz_inside(wild: Path) -> None:
    pytest.importorskip("flexgs_edge.io.spz")
    source = own(wild / "cesium-spz-basic.glb")
    # The file states positions that are those of its .spz as they are; the node turns y and z.
    np.testing.assert_allclose(planes(source)["means"], [[1], [3], [-2]], atol=1e-6)
