"""Which way is up: the convention, unless a ground or a ring of cameras shows otherwise."""

from __future__ import annotations

import math

import numpy as np
import pytest

from flexgs_edge.cameras.auto import automatic_rig
from flexgs_edge.cameras.scene_sample import sample_scene, sh_basis
from flexgs_edge.cameras.up import Stands, find_up
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from kernel_fixtures import drawing
from synthetic import joined, make_splats

AXES = {"-y": (0, -1, 0), "+y": (0, 1, 0), "+z": (0, 0, 1), "-z": (0, 0, -1), "+x": (1, 0, 0), "-x": (-1, 0, 0)}
TILTED = (-0.45, -0.65, -0.6)


def to_up(up: tuple[float, float, float]) -> np.ndarray:
    """A rotation ([3, 3]) that turns +z to `up`, and something about it."""
    z = np.array(up) / np.linalg.norm(up)
    x = np.cross(z, [0.3, 0.5, -0.8])
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z], axis=1)


def turned(source: MemorySource, rotation: np.ndarray) -> MemorySource:
    """The scene in another frame. SH above degree 0 are left as they are."""
    planes = source.read(slice(0, source.count), list(FIELD))
    planes["means"] = (rotation @ planes["means"]).astype(np.float32)
    turn = quaternion(rotation)
    w, x, y, z = planes["quats"]
    a, b, c, d = turn
    planes["quats"] = np.array(
        [
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        ],
        np.float32,
    )
    return MemorySource(planes, source.sh_degree)


def quaternion(rotation: np.ndarray) -> np.ndarray:
    """[4], w x y z."""
    values, lines = np.linalg.eig(rotation)
    axis = np.real(lines[:, np.argmin(np.abs(values - 1))])
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    start = np.cross(axis, helper)
    start /= np.linalg.norm(start)
    end = rotation @ start
    angle = math.atan2(float(axis @ np.cross(start, end)), float(start @ end))
    return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis / np.linalg.norm(axis)])


def table(seed: int = 0) -> MemorySource:
    """A flat top in z = 0, of thin splats, with a few things on it and one leg below."""
    rng = np.random.default_rng(seed)
    top = np.concatenate([rng.uniform(-2, 2, (1500, 2)), rng.normal(0, 0.005, (1500, 1))], axis=1)
    things = rng.normal([0.3, -0.2, 0.6], 0.25, (900, 3))
    leg = np.stack([rng.normal(0, 0.05, 60), rng.normal(0, 0.05, 60), rng.uniform(-1, -0.1, 60)], axis=1)
    return joined(
        make_splats(top, np.full((1500, 3), [0.08, 0.08, 0.004])),
        turned_at_random(make_splats(things, np.full((900, 3), [0.05, 0.04, 0.01])), rng),
        make_splats(leg, np.full((60, 3), 0.05)),
    )


def turned_at_random(source: MemorySource, rng: np.random.Generator) -> MemorySource:
    planes = source.read(slice(0, source.count), list(FIELD))
    planes["quats"] = rng.normal(size=(4, source.count)).astype(np.float32)
    return MemorySource(planes, source.sh_degree)


def ball(seed: int = 0) -> MemorySource:
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(1500, 3))
    points *= rng.uniform(0, 1, (1500, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return turned_at_random(make_splats(points, np.full((1500, 3), [0.1, 0.1, 0.02])), rng)


def seen_from_a_ring(up: tuple[float, float, float]) -> MemorySource:
    """A ball with SH as training leaves them, from cameras on a ring, a little above its middle."""
    rng, source = np.random.default_rng(0), ball()
    planes = source.read(slice(0, source.count), list(FIELD))
    angles = np.arange(16) * math.pi / 8
    ring = to_up(up) @ np.stack([4 * np.cos(angles), 4 * np.sin(angles), np.full(16, 1.2)])
    total = np.zeros((3, 15, source.count))
    for eye in ring.T:
        lines = planes["means"] - eye[:, None]
        facing = np.maximum(-(planes["means"] * lines).sum(axis=0), 0)  # the near side is seen
        lines = lines / np.linalg.norm(lines, axis=0)
        total += rng.normal(0, 0.05, (3, 1, source.count)) * facing * sh_basis(lines.astype(np.float64), 15)
    planes["sh_rest"] = total.reshape(45, source.count).astype(np.float32)
    return MemorySource(planes, 3)


def up_of(source: MemorySource) -> tuple[np.ndarray, str]:
    """What the top of the images points to on the whole, and the end of the note."""
    rig = automatic_rig(source, drawing(), 16, 64, 48)
    assert rig.cameras[0].width == 64
    rights = np.array([camera.rotation[0] for camera in rig.cameras])
    # Level horizons: every right vector is across up.
    _, _, lines = np.linalg.svd(rights)
    downs = np.array([camera.rotation[1] for camera in rig.cameras])
    return lines[2] * -np.sign((downs @ lines[2]).sum()), rig.note.rpartition("; ")[2]


@pytest.mark.parametrize("up", [*AXES.values(), TILTED])
def test_a_table_shows_up(up: tuple[float, float, float]) -> None:
    found, note = up_of(turned(table(), to_up(up)))
    assert found @ np.array(up) / np.linalg.norm(up) > math.cos(math.radians(2)) and note.endswith("(ground)")


@pytest.mark.parametrize("up", [AXES["+z"], AXES["-y"], AXES["+x"], TILTED])
def test_a_ring_of_cameras_shows_up(up: tuple[float, float, float]) -> None:
    found, note = up_of(seen_from_a_ring(up))
    assert found @ np.array(up) / np.linalg.norm(up) > math.cos(math.radians(12)) and note.endswith("(camera ring)")


@pytest.mark.parametrize("name", AXES)
def test_names_of_axes(name: str) -> None:
    source = table() if name == "+z" else turned(table(), to_up(AXES[name]))
    assert up_of(source)[1] == f"up is {name} (ground)"


def box(half: tuple[float, float, float], seed: int = 0) -> MemorySource:
    """Six faces of thin splats."""
    rng, parts = np.random.default_rng(seed), []
    for axis in range(3):
        points = rng.uniform(-1, 1, (600, 3)) * half
        points[:, axis] = half[axis] * rng.choice([-1.0, 1.0], 600)
        deviations = np.full((600, 3), 0.15)
        deviations[:, axis] = 0.005
        parts.append(make_splats(points, deviations))
    return joined(*parts)


def sheet(count: int = 800) -> MemorySource:
    points = np.random.default_rng(0).uniform(-2, 2, (count, 3)) * [1, 0.2, 0]
    return make_splats(points, np.full((count, 3), [0.1, 0.1, 0.003]))


@pytest.mark.parametrize(
    ("source", "why"),
    [
        (ball(), "an object: a beetle or a guitar"),
        (turned(ball(), to_up(TILTED)), "an object, turned"),
        (box((1, 1, 1)), "all faces of a cube are alike"),
        (turned(box((2, 2, 1)), to_up(TILTED)), "floor and ceiling are alike"),
        (turned(sheet(), to_up(TILTED)), "nothing stands on a sheet"),
        (make_splats(np.zeros((1, 3)), np.array([[1, 1, 0.01]])), "one splat is no ground"),
    ],
)
def test_weak_evidence_changes_nothing(source: MemorySource, why: str) -> None:
    found, note = up_of(source)
    assert note == "up is -y (convention)", why
    assert abs(found[1]) > 0.999 or source.count == 1, why


def test_a_wall_that_all_views_face_is_no_ground() -> None:
    scene = sample_scene(seen_from_a_ring((0, 0, 1)))
    rng = np.random.default_rng(0)
    at = np.stack([*rng.uniform(-3, 3, (2, 50)), np.full(50, -5.0)])
    frontal = Stands(at, np.ones(50), np.repeat([[0.1], [0.0], [0.99]], 20, axis=1))
    assert find_up(scene, frontal).reason == "convention"
    around = Stands(at, np.ones(50), np.array([[0.9, -0.9, 0, 0], [0, 0, 0.9, -0.9], [0.4] * 4]))
    assert find_up(scene, around).reason == "camera ring"
    np.testing.assert_array_equal(find_up(scene, around).direction, [0, 0, -1])  # views look down


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0.2), (1e200, 0, 0)])
def test_a_given_up_overrides_all(up: tuple[float, float, float]) -> None:
    rig = automatic_rig(table(), drawing(), 8, 64, 48, np.array(up, float))
    assert rig.note.endswith("(--up)")
    for camera in rig.cameras:
        assert abs(camera.rotation[0] @ np.array(up, float)) < 1e-9 * max(up)


def test_the_sample_is_z_up(sample_dir: object) -> None:
    rig = automatic_rig(PlySource(f"{sample_dir}/point_cloud.ply"), drawing(), 8)
    assert "up is +z (ground" in rig.note
