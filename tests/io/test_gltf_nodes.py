"""Nodes of a glTF: hierarchies, and what matrices make of covariances, colours and positions far from zero."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.io.gltf import read_gltf
from flexgs_edge.io.reading import AS_WRITTEN
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import matrices, sh_functions
from flexgs_edge.scene.source import Planes, SceneSource
from gltf_files import GltfBuilder, splat_arrays

ARRAYS = splat_arrays(20, 3)


def read(builder: GltfBuilder, folder: Path) -> SceneSource:
    path = builder.glb(folder / "a.glb")
    return read_gltf(path, str(path), AS_WRITTEN)


def planes(source: SceneSource) -> Planes:
    return {
        name: values.astype(np.float64) for name, values in source.read(slice(0, source.count), list(FIELD)).items()
    }


def covariances(found: Planes) -> np.ndarray:
    """[n, 3, 3] f64."""
    axes = matrices(found["quats"]) * np.exp(found["log_scales"]).T[:, None]
    return axes @ axes.transpose(0, 2, 1)


def colours(found: Planes, directions: np.ndarray) -> np.ndarray:
    """[3, n, d], SH above degree 0 in some directions."""
    rest = found["sh_rest"].reshape(3, 15, -1)
    return np.einsum("ckn,kd->cnd", rest, sh_functions(3, directions))


def rotation(seed: int) -> np.ndarray:
    quat = np.random.default_rng(seed).normal(size=4)
    return matrices(quat[:, None])[0]


def as_matrix(linear: np.ndarray, offset: tuple[float, float, float] = (0, 0, 0)) -> list[float]:
    """A node's matrix: columns, one after the other."""
    whole = np.eye(4)
    whole[:3, :3], whole[:3, 3] = linear, offset
    return [float(value) for value in whole.T.ravel()]


LINEAR = {
    "identity": np.eye(3),
    "rotation": rotation(1),
    "uniform": 2.5 * rotation(2),
    "six digits": np.round(0.37 * rotation(3), 6),
    "stretched": rotation(4) @ np.diag([0.5, 1, 3]),
    "sheared": np.array([[1, 0.7, 0], [0, 1, -0.4], [0.2, 0, 1]]),
    "mirror": np.diag([-1.0, 1, 1]),
    "turned mirror": -1.5 * rotation(5),
    "stretched mirror": rotation(6) @ np.diag([0.5, -1, 3]),
    "tiny": 1e-200 * rotation(7),
    "huge": 1e20 * rotation(8) @ np.diag([1, 1, 2]),
}


@pytest.mark.parametrize("name", LINEAR)
def test_matrices_move_gaussians(tmp_path: Path, name: str) -> None:
    linear = LINEAR[name]
    still, moved = GltfBuilder(), GltfBuilder()
    still.splats(ARRAYS)
    moved.splats(ARRAYS, matrix=as_matrix(linear, (1, 2, 3)))
    before, source = planes(read(still, tmp_path)), read(moved, tmp_path)
    after = planes(source)
    check_scene(source)
    size = np.abs(linear).max()
    wanted = linear @ before["means"] + np.array([[1], [2], [3]])
    np.testing.assert_allclose(
        after["means"] + source.origin[:, None], wanted, atol=1e-6 * max(1, np.abs(wanted).max())
    )
    after["log_scales"] -= np.log(size)
    expected = (linear / size) @ covariances(before) @ (linear / size).T
    scale = np.abs(expected).max(axis=(1, 2), keepdims=True)
    # float32 has fewer digits for the logarithms of very large and small scales.
    rounding = 3e-6 + 2e-7 * abs(np.log(size))
    np.testing.assert_allclose(covariances(after) / scale, expected / scale, atol=rounding)
    left, _, right = np.linalg.svd(linear)
    directions = np.random.default_rng(0).normal(size=(3, 30))
    directions /= np.linalg.norm(directions, axis=0)
    np.testing.assert_allclose(colours(after, directions), colours(before, (left @ right).T @ directions), atol=1e-5)
    np.testing.assert_array_equal(after["sh_dc"], before["sh_dc"])
    np.testing.assert_array_equal(after["opacity_logits"], before["opacity_logits"])


def test_uniform_scales_are_exact(tmp_path: Path) -> None:
    still, moved = GltfBuilder(), GltfBuilder()
    still.splats(ARRAYS)
    moved.splats(ARRAYS, scale=[4, 4, 4], translation=[1, 0, 0])
    before, after = planes(read(still, tmp_path)), planes(read(moved, tmp_path))
    np.testing.assert_array_equal(after["quats"], before["quats"])
    np.testing.assert_array_equal(after["sh_rest"], before["sh_rest"])
    np.testing.assert_allclose(after["log_scales"], before["log_scales"] + np.log(4), atol=3e-7)


def test_trees_of_nodes(tmp_path: Path) -> None:
    """A chain of translation, rotation and scale is the product of their matrices, whatever else is in the tree."""
    chain, whole = GltfBuilder(), GltfBuilder()
    chain.splats(ARRAYS)
    chain.record["nodes"] = [
        {"children": [2, 1], "translation": [1, 2, 3], "rotation": [0, 0, np.sin(0.5), np.cos(0.5)]},
        {"children": [3], "scale": [2, 2, 2]},
        {"name": "a camera", "camera": 0},
        {"mesh": 0, "matrix": as_matrix(rotation(1), (0, 5, 0))},
        {"mesh": 0},  # not in the scene
    ]
    chain.record["scenes"] = [{"nodes": [4]}, {"nodes": [0]}]
    chain.record["scene"] = 1
    turn = np.array([[np.cos(1), -np.sin(1), 0], [np.sin(1), np.cos(1), 0], [0, 0, 1]])
    linear = turn @ (2 * rotation(1))
    offset = turn @ (2 * np.array([0, 5, 0])) + [1, 2, 3]
    whole.splats(ARRAYS, matrix=as_matrix(linear, tuple(offset)))
    found, wanted = read(chain, tmp_path), read(whole, tmp_path)
    assert found.count == 20
    for name, values in planes(wanted).items():
        np.testing.assert_allclose(planes(found)[name], values, atol=2e-6, err_msg=name)


def test_without_scenes_all_nodes_are_shown(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.splats(ARRAYS)
    builder.node(root=False, children=[0], translation=[1, 0, 0])
    del builder.record["scenes"], builder.record["scene"]
    source = read(builder, tmp_path)
    assert source.count == 20
    np.testing.assert_allclose(planes(source)["means"][0], ARRAYS["POSITION"][:, 0] + 1, atol=1e-6)
    builder.record["scenes"] = [{"nodes": [1]}, {"nodes": [0]}]  # the first one, if none is named
    np.testing.assert_allclose(planes(read(builder, tmp_path))["means"][0], ARRAYS["POSITION"][:, 0] + 1, atol=1e-6)


def test_one_mesh_in_many_places(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.splats(ARRAYS)
    builder.node(mesh=0, translation=[5, 0, 0])
    builder.node(mesh=0, scale=[0, 0, 0])
    source = read(builder, tmp_path)
    assert (source.count, source.notes) == (40, ("nodes scaled to nothing left out",))
    assert source.held_bytes == sum(values.nbytes for values in ARRAYS.values())
    found = planes(source)["means"]
    np.testing.assert_allclose(found[:, 20:] - found[:, :20], np.repeat([[5.0], [0], [0]], 20, axis=1), atol=1e-6)


def test_positions_far_from_zero_keep_their_digits(tmp_path: Path) -> None:
    builder = GltfBuilder()
    builder.splats(ARRAYS, matrix=as_matrix(rotation(1), (4.5e6, -1.2e6, 3.3e6 + 0.25)))
    source = read(builder, tmp_path)
    assert np.abs(source.origin).min() > 1e6
    world = planes(source)["means"] + source.origin[:, None]
    wanted = rotation(1) @ ARRAYS["POSITION"].T.astype(np.float64) + np.array([[4.5e6], [-1.2e6], [3.3e6 + 0.25]])
    np.testing.assert_allclose(world, wanted, rtol=0, atol=1e-6)


@pytest.mark.parametrize("name", ["identity", "uniform", "sheared"])
def test_invalid_rows_pass_through(tmp_path: Path, name: str) -> None:
    arrays = {name: values.copy() for name, values in splat_arrays(5).items()}
    arrays["SCALE"][0, 1], arrays["SCALE"][1] = np.nan, np.inf
    arrays["ROTATION"][2] = 0
    arrays["ROTATION"].view(np.uint32)[3, 0] = 0x7F800001  # NaN that signals
    builder = GltfBuilder()
    builder.splats(arrays, matrix=as_matrix(LINEAR[name]))
    source = check_scene(read(builder, tmp_path), drop_invalid=True)
    assert source.count == 1
    assert source.notes[0].startswith("4 of 5 Gaussians left out as invalid")
    assert np.isfinite(planes(source)["quats"]).all()


def test_flat_gaussians_stay_flat_under_a_shear(tmp_path: Path) -> None:
    arrays = splat_arrays(3)
    arrays["SCALE"][0, 2] = 0
    arrays["SCALE"][1] = 0
    builder = GltfBuilder()
    builder.splats(arrays, matrix=as_matrix(LINEAR["sheared"]))
    found = planes(read(builder, tmp_path))
    flat = found["log_scales"] < -25  # zero, or what rounding makes of it
    np.testing.assert_array_equal(flat.sum(axis=0), [1, 3, 0])
    np.testing.assert_allclose(np.linalg.norm(found["quats"], axis=0), 1, atol=1e-6)
