"""What the reader of .glb and .gltf refuses: other contents, claims that the bytes do not bear, cut files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.errors import FlexGSError, FormatError, InputError
from flexgs_edge.scene.check import check_scene
from gltf_files import EXTENSION, GltfBuilder, own, splat_arrays


@pytest.fixture
def builder() -> GltfBuilder:
    return GltfBuilder()


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
    ("accessors.0", "count", -1, "accessors.0..count: expected a whole number, 0 or more, found -1"),
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
    ("nodes.0", "rotation", [0, 0, 1], "rotation: expected 4 finite numbers"),
    ("nodes.0", "scale", [1, 1, float("nan")], "scale: expected 3 finite numbers, found .1, 1, nan."),
    ("nodes.0", "translation", [10**400, 0, 0], "translation: expected 3 finite numbers"),
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
    with pytest.raises(FormatError, match=r"accessors\[5\].count: expected a number that a file of \d+ bytes may have"):
        own(builder.glb(path))


def test_nodes_cannot_show_more_than_the_bytes_bear(builder: GltfBuilder, tmp_path: Path) -> None:
    builder.splats(splat_arrays(2000))
    for _ in range(1500):
        builder.node(mesh=0)
    with pytest.raises(FormatError, match=r"a.glb: shows more than \d+ Gaussians, but has \d+ bytes"):
        own(builder.glb(tmp_path / "a.glb"))
