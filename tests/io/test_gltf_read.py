"""Reading splats from .glb and .gltf: accessors, buffers, and drafts of the extension."""

from __future__ import annotations

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import InputError
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import Planes, Rows
from gltf_files import EXTENSION, GltfBuilder, own, planes, splat_arrays
from scene_files import open_scene


@pytest.fixture
def builder() -> GltfBuilder:
    return GltfBuilder()


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
