"""Turning scenes between frames: against the basis functions themselves, and by pictures."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from flexgs_edge.cameras.scene_sample import sh_basis
from flexgs_edge.constants import SH_C4
from flexgs_edge.errors import InputError
from flexgs_edge.io.frames import LUF, RDF, RUB, Frame, FrameSource, in_frame
from flexgs_edge.kernels.tested import open_backend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.rotations import turned
from synthetic import look_from, make_camera, random_scene

FRAMES = ["".join(letters) for letters in product("RL", "DU", "FB")]
ALL = [field.name for field in FIELDS]


def basis_of_degree_4(directions: np.ndarray) -> np.ndarray:
    """[9, n], the functions of degree 4 in unit `directions` ([3, n]), as Sloan writes them."""
    x, y, z = directions
    xx, yy, zz = x * x, y * y, z * z
    return np.array(
        [
            SH_C4[0] * x * y * (xx - yy),
            SH_C4[1] * y * z * (3 * xx - yy),
            SH_C4[2] * x * y * (7 * zz - 1),
            SH_C4[3] * y * z * (7 * zz - 3),
            SH_C4[4] * (zz * (35 * zz - 30) + 3),
            SH_C4[5] * x * z * (7 * zz - 3),
            SH_C4[6] * (xx - yy) * (7 * zz - 1),
            SH_C4[7] * x * z * (xx - 3 * yy),
            SH_C4[8] * (xx * (xx - 3 * yy) - yy * (3 * xx - yy)),
        ]
    )


@pytest.mark.parametrize("name", FRAMES)
def test_signs_of_sh_are_those_of_the_basis(name: str) -> None:
    """f(S d) = s f(d) for each basis function f, so s times the coefficient gives the same colour in the turned direction."""
    frame = Frame(name)
    directions = np.random.default_rng(1).normal(size=(3, 40))
    directions /= np.linalg.norm(directions, axis=0)
    there = directions * frame.signs[:, None]
    for degree, count in ((0, 0), (1, 3), (2, 8), (3, 15)):
        signs = frame.sh_signs(degree)
        assert signs.dtype == np.float32 and signs.shape == (count,)
        np.testing.assert_allclose(sh_basis(there, count), signs[:, None] * sh_basis(directions, count), atol=1e-12)
    signs = frame.sh_signs(4)
    assert signs.shape == (24,)
    np.testing.assert_array_equal(signs[:15], frame.sh_signs(3))
    np.testing.assert_allclose(basis_of_degree_4(there), signs[15:, None] * basis_of_degree_4(directions), atol=1e-12)


@pytest.mark.parametrize("name", FRAMES)
def test_covariances_turn_with_the_axes(name: str) -> None:
    frame = Frame(name)
    rng = np.random.default_rng(2)
    quats, scales = rng.normal(size=(4, 9)).astype(np.float32), rng.uniform(0.1, 2, (3, 9))

    def covariances(quats: np.ndarray) -> np.ndarray:
        unit = quats / np.linalg.norm(quats, axis=0)
        axes = np.stack([turned(unit, np.tile(axis[:, None], 9) * scales) for axis in np.eye(3)])  # [axis, 3, n]
        return np.einsum("ain,akn->nik", axes, axes)

    signs = np.diag(frame.signs)
    expected = signs @ covariances(quats) @ signs
    np.testing.assert_allclose(covariances(quats * frame.quat_signs[:, None]), expected, atol=1e-5)


@pytest.mark.parametrize("name", FRAMES)
@pytest.mark.parametrize("degree", [0, 2, 4])
def test_turning_twice_changes_nothing(name: str, degree: int) -> None:
    scene = random_scene(20, seed=4, degree=degree, origin=(100.0, 0.0, -200.0))
    twice = FrameSource(FrameSource(scene, Frame(name)), Frame(name))
    for field, values in twice.read(slice(0, 20), ALL).items():
        np.testing.assert_array_equal(values, scene.read(slice(0, 20), [field])[field])
    np.testing.assert_array_equal(twice.origin, scene.origin)
    assert not np.signbit(twice.origin[1])


@pytest.mark.parametrize("name", ["RUB", "LUF", "RUF", "LDF"])
def test_a_turned_camera_sees_the_same_picture(name: str) -> None:
    """In a mirrored frame too: its camera has a rotation that mirrors."""
    frame, scene = Frame(name), random_scene(40, seed=6, degree=3)
    rotation, translation = look_from(2)
    camera = make_camera(64, 48, 60.0, rotation, translation)
    moved = replace(camera, rotation=rotation * frame.signs)
    budget = MemoryBudget(2**30)
    renderer = Renderer(open_backend(None, budget), budget)
    with renderer.load(scene) as loaded:
        expected = renderer.render(loaded, camera)
    with renderer.load(in_frame(scene, frame)) as loaded:
        found = renderer.render(loaded, moved)
        other = renderer.render(loaded, camera)
    assert np.abs(found - expected).max() < 1e-5
    assert np.abs(other - expected).max() > 0.1


def test_what_a_turned_scene_keeps() -> None:
    scene = random_scene(5, degree=1)
    scene.settings, scene.held_bytes, scene.notes = {"antialiased": True}, 7, ("a note",)
    there = in_frame(scene, RUB)
    assert (there.settings, there.held_bytes, there.notes) == (scene.settings, 7, ("a note",))
    assert (there.count, there.sh_degree, there.sh_count) == (5, 1, 5)
    assert in_frame(scene, RDF) is scene


def test_rows_and_arrays_of_the_caller() -> None:
    scene = random_scene(9, seed=1, degree=1)
    there = in_frame(scene, LUF)
    whole = there.read(slice(0, 9), ALL)
    out = {"means": np.empty((3, 2), np.float32)}
    some = there.read(np.array([2, 7]), ALL, out)
    assert some["means"] is out["means"]
    for field in ALL:
        np.testing.assert_array_equal(some[field], whole[field][:, [2, 7]])
    np.testing.assert_array_equal(
        scene.read(slice(0, 9), ["means"])["means"],
        random_scene(9, seed=1, degree=1).read(slice(0, 9), ["means"])["means"],
    )


@pytest.mark.parametrize("name", ["", "RD", "RDFX", "XYZ", "DRF", "rub", "RUU"])
def test_names_that_are_no_frame(name: str) -> None:
    with pytest.raises(InputError, match=r"expected three letters, R or L \(x\)"):
        Frame(name)
