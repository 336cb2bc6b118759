"""What independent programs make of our .glb: PlayCanvas, three.js and Khronos's validator. They run in node."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.io.exchange import read_foreign, write_foreign
from flexgs_edge.io.gltf import EXTENSION
from flexgs_edge.io.ply import write_ply
from flexgs_edge.io.reading import Writing
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.rotations import matrices, normalize_quats
from flexgs_edge.scene.source import MemorySource, Planes
from synthetic import random_scene

SCRIPT = Path(__file__).with_name("load_glb.mjs")
SPZ_SCRIPT = Path(__file__).with_name("load_glb_spz.mjs")
COUNT = 100


def loaded(modules: Path, path: Path, script: Path = SCRIPT) -> dict[str, Any]:
    """What the programs read."""
    done = subprocess.run(
        ["node", str(script), str(modules), str(path)], capture_output=True, text=True, timeout=120, check=False
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def by_place(means: np.ndarray) -> np.ndarray:
    """An order of rows that only depends on positions ([3, n])."""
    return np.lexsort(means.astype(np.float64))


def covariances(planes: Planes) -> np.ndarray:
    """[n, 3, 3] f64."""
    axes = matrices(planes["quats"]) * np.exp(planes["log_scales"].astype(np.float64)).T[:, None]
    return axes @ axes.transpose(0, 2, 1)


@pytest.fixture(scope="session")
def scene() -> MemorySource:
    source = random_scene(COUNT, seed=5, degree=3)
    return MemorySource(source.read(slice(0, COUNT), list(FIELD)))


@pytest.fixture(scope="session")
def ours(scene: MemorySource) -> Planes:
    """The scene's values in glTF's frame (x left, y up), by place."""
    planes = scene.read(slice(0, COUNT), list(FIELD))
    planes["means"] *= np.array([[-1], [-1], [1]], np.float32)
    planes["quats"] = normalize_quats(planes["quats"]) * np.array([[1], [-1], [-1], [1]], np.float32)
    order = by_place(planes["means"])
    return {name: values[:, order].astype(np.float64) for name, values in planes.items()}


@pytest.fixture(scope="session")
def theirs(node_modules: Path, scene: MemorySource, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    path = tmp_path_factory.mktemp("glb") / "a.glb"
    write_foreign(path, scene)
    return loaded(node_modules, path)


def test_playcanvas_reads_the_same_values(theirs: dict[str, Any], ours: Planes) -> None:
    table = {name: np.array(values, np.float64) for name, values in theirs["playcanvas"].items()}
    order = by_place(np.stack([table[name] for name in "xyz"]))
    found = {
        name: np.stack([table[column][order] for column in FIELD[name].ply_names(3)])
        for name in ("means", "sh_dc", "sh_rest", "quats")
    }
    for name in ("means", "sh_dc"):
        np.testing.assert_allclose(found[name], ours[name], atol=1e-6, err_msg=name)
    scales = np.stack([table[f"scale_{axis}"][order] for axis in range(3)])
    np.testing.assert_allclose(np.log(scales), ours["log_scales"], atol=1e-5)
    np.testing.assert_allclose(table["opacity"][order], 1 / (1 + np.exp(-ours["opacity_logits"][0])), atol=1e-6)
    turned = np.abs((found["quats"] * ours["quats"]).sum(axis=0))
    np.testing.assert_allclose(turned, 1, atol=5e-5)
    # x and y change their signs: a function is odd as often as both appear in it.
    odd = np.array([-1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1, 1, -1])
    np.testing.assert_allclose(found["sh_rest"], ours["sh_rest"] * np.tile(odd, 3)[:, None], atol=1e-6)


def test_three_reads_the_same_values(theirs: dict[str, Any], ours: Planes) -> None:
    found = {name: np.array(values, np.float64) for name, values in theirs["three"].items()}
    means = found["position"].reshape(-1, 3).T
    order = by_place(means)
    np.testing.assert_allclose(means[:, order], ours["means"], atol=1e-6)
    expected = covariances(ours).reshape(-1, 9)[:, [0, 1, 2, 4, 5, 8]]
    np.testing.assert_allclose(found["covariance"].reshape(-1, 6)[order], expected, atol=1e-4)
    opacities = found["color"].reshape(-1, 4)[order, 3]
    np.testing.assert_allclose(opacities, 255 / (1 + np.exp(-ours["opacity_logits"][0])), atol=0.51)


def test_the_validator_finds_nothing(theirs: dict[str, Any]) -> None:
    messages = theirs["validated"]
    assert {message["code"] for message in messages} >= {"UNSUPPORTED_EXTENSION"}
    # It does not know the extension yet, and so neither the names that its text demands.
    strange = [
        message
        for message in messages
        if message["severity"] < 2
        and not (
            message["code"] == "MESH_PRIMITIVE_INVALID_ATTRIBUTE" and "/KHR_gaussian_splatting:" in message["pointer"]
        )
    ]
    assert strange == []


def test_splat_transform_writes_what_we_read(node_modules: Path, scene: MemorySource, tmp_path: Path) -> None:
    write_ply(tmp_path / "a.ply", scene)
    program = node_modules / "@playcanvas" / "splat-transform" / "bin" / "cli.mjs"
    done = subprocess.run(
        ["node", str(program), "-q", "-w", "-g", "cpu", str(tmp_path / "a.ply"), str(tmp_path / "b.glb")],
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    back = read_foreign(tmp_path / "b.glb")
    assert (back.count, back.sh_degree, back.notes) == (COUNT, 3, ())
    write_foreign(tmp_path / "c.glb", scene)
    ours = read_foreign(tmp_path / "c.glb")
    a, b = (source.read(slice(0, COUNT), list(FIELD)) for source in (ours, back))
    a, b = ({name: values[:, by_place(planes["means"])] for name, values in planes.items()} for planes in (a, b))
    for name in ("means", "sh_dc", "sh_rest", "log_scales", "opacity_logits"):
        np.testing.assert_allclose(a[name], b[name], atol=2e-5, err_msg=name)
    # It turns the rotations, we also turn each Gaussian's own axes: the same covariances.
    np.testing.assert_allclose(covariances(a), covariances(b), atol=1e-4)


def test_cesium_reads_the_spz_inside(node_modules: Path, scene: MemorySource, tmp_path: Path) -> None:
    if not (node_modules / "@cesium").is_dir():
        pytest.skip("no CesiumJS: deploy/test.sh installs it")
    far = MemorySource(scene.read(slice(0, COUNT), list(FIELD)), origin=np.array([5e5, 0, -300]))
    write_foreign(tmp_path / "a.glb", far, writing=Writing(glb="spz"))
    theirs = loaded(node_modules, tmp_path / "a.glb", SPZ_SCRIPT)
    assert theirs["matrix"] == [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, -5e5, 0, -300, 1]
    back = read_foreign(tmp_path / "a.glb")
    ours = back.read(slice(0, COUNT), list(FIELD))
    ours["means"] += (back.origin - far.origin)[:, None]
    # It takes the values as the .spz has them: half a turn about y away from what the extension's text wants.
    turn = np.array([1, -1, -1])
    columns = {
        name.removeprefix(f"{EXTENSION}:"): np.reshape(values, (COUNT, -1)).T
        for name, values in theirs.items()
        if name != "matrix"
    }
    np.testing.assert_allclose(columns["POSITION"] * turn[:, None], ours["means"], atol=1e-6)
    np.testing.assert_allclose(np.log(columns["SCALE"]), ours["log_scales"], atol=1e-5)
    colours = np.concatenate([ours["sh_dc"] * 0.28209479 + 0.5, 1 / (1 + np.exp(-ours["opacity_logits"]))])
    assert np.abs(columns["COLOR_0"] - 255 * np.clip(colours, 0, 1)).max() < 1.01
    quats = columns["ROTATION"][[3, 0, 1, 2]] * np.array([1, *turn])[:, None]
    np.testing.assert_allclose(np.abs((quats * ours["quats"]).sum(axis=0)), 1, atol=1e-5)
    rest = ours["sh_rest"].reshape(3, 15, COUNT)
    # Functions odd in an odd number of y and z.
    odd = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1]
    places = [(1, 3, 0), (2, 5, 3), (3, 7, 8)]
    for degree, count, start in places:
        for number in range(count):
            found = columns[f"SH_DEGREE_{degree}_COEF_{number}"]
            expected = rest[:, start + number] * odd[start + number]
            np.testing.assert_allclose(found, expected, atol=1e-6, err_msg=f"{degree} {number}")
