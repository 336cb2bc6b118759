"""The automatic rig: never inside matter, where the scene is meant to be seen from, always the same, good to rank by."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from flexgs_edge.cameras.auto import automatic_rig
from flexgs_edge.cameras.camera import Camera, split_views
from flexgs_edge.cameras.candidates import Show, look
from flexgs_edge.cameras.directions import fibonacci
from flexgs_edge.cameras.photos import Photos
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.cameras.scene_sample import sample_scene, sh_basis, weighted_quantiles
from flexgs_edge.errors import InputError
from flexgs_edge.goals.steps import Choice
from flexgs_edge.io.ply import PlySource
from flexgs_edge.methods.paper.method import score_scene
from flexgs_edge.methods.paper.prune import nonzero_sh, order_from_scores, ranks_from_order, select_rows
from flexgs_edge.packed.bitpack import PAPER
from flexgs_edge.packed.quantize import quantize_scene, quantized_bytes
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, SceneSource
from kernel_fixtures import default_device, draw, drawing, large_budget, open_form
from synthetic import joined, make_splats


def ball(
    radius: float = 1.0, count: int = 3000, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0
) -> MemorySource:
    """A solid opaque object (a hollow one without SH could as well be a room)."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(count, 3))
    points *= radius * rng.uniform(0, 1, (count, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return make_splats(points + centre, np.full((count, 3), 1.2 * radius / count ** (1 / 3)), opacity=0.95)


def room(half: float = 4.0, count: int = 6000, seed: int = 0) -> MemorySource:
    """Six walls around an empty middle."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-half, half, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = half * rng.choice([-1.0, 1.0], count)
    return make_splats(points, np.full((count, 3), 2.5 * half / math.sqrt(count / 6)), opacity=0.95)


def with_sh(source: MemorySource, eye: np.ndarray, degree: int = 3, seed: int = 0) -> MemorySource:
    """SH as training from `eye` leaves them: steps along the basis of the directions looked from, times some gradient."""
    rng = np.random.default_rng(seed)
    planes = source.read(slice(0, source.count), list(FIELD))
    kept = sh_rest_count(degree)
    total = np.zeros((3, kept, source.count))
    for _ in range(6):
        lines = planes["means"] - (eye + rng.normal(0, 0.5, 3))[:, None]
        lines = lines / np.linalg.norm(lines, axis=0)
        total += rng.normal(0, 0.05, (3, 1, source.count)) * sh_basis(lines.astype(np.float64), kept)
    planes["sh_rest"] = total.reshape(3 * kept, source.count).astype(np.float32)
    return MemorySource(planes, degree)


def placed(source: SceneSource, views: int = 48, width: int = 640, height: int = 480) -> tuple[list[Camera], str]:
    """Cameras of the automatic rig, and its note."""
    rig = automatic_rig(source, drawing(), views, width, height)
    return rig.cameras, rig.note


def centres(cameras: list[Camera]) -> np.ndarray:
    return np.array([camera.center for camera in cameras])


def forwards(cameras: list[Camera]) -> np.ndarray:
    return np.array([camera.rotation[2] for camera in cameras])


def blocked(source: SceneSource, camera: Camera, near: float) -> float:
    """Light of a view that is gone before `near` scene units, in the mean over pixels (0 to 1)."""
    rows = source.read(slice(0, source.count), list(FIELD))
    close = np.linalg.norm(rows["means"] - (camera.center - source.origin)[:, None], axis=0) < near
    white = {name: plane[:, close] for name, plane in rows.items() if name != "sh_rest"}
    white["sh_dc"] = np.full((3, int(close.sum())), 0.5 / 0.28209479177387814, np.float32)
    if not close.any():
        return 0.0
    return float(draw(open_form("w16"), MemorySource(white), camera.scaled(32, 24), near=0.01).mean())


def test_an_object_is_seen_from_outside() -> None:
    source = ball(1.0, centre=(10.0, -3.0, 2.0))
    cameras, note = placed(source, views=16, width=64, height=48)
    offsets = centres(cameras) - [10.0, -3.0, 2.0]
    distance = np.linalg.norm(offsets, axis=1)
    assert distance.min() > 1.2 and distance.max() < 8
    # They look at it, and they stand around it.
    assert (np.einsum("vx,vx->v", forwards(cameras), -offsets / distance[:, None]) > 0.7).all()
    directions = offsets / distance[:, None]
    assert np.linalg.norm(directions.mean(axis=0)) < 0.35
    assert (directions @ fibonacci(12).T).max(axis=0).min() > 0.6
    assert "16 automatic views from outside" in note and "where the scene looks sharp;" in note


def test_a_room_is_seen_inside_out() -> None:
    source = room()
    cameras, note = placed(source, views=16, width=64, height=48)
    assert (np.abs(centres(cameras)) < 3.9).all()
    # All six walls are looked at.
    assert (forwards(cameras) @ np.concatenate([np.eye(3), -np.eye(3)]).T).max(axis=0).min() > 0.6
    assert "inside out" in note


def test_an_object_in_a_room_is_seen_between_the_two() -> None:
    source = joined(ball(0.8, 2500), room(5.0))
    cameras, _ = placed(source, views=16, width=64, height=48)
    assert (np.linalg.norm(centres(cameras), axis=1) > 0.9).all() and (np.abs(centres(cameras)) < 4.9).all()


def test_a_small_thing_apart_is_looked_at_from_near_by() -> None:
    """Eight views of it on top, and one of them decides. What touches all else gets none."""
    centre = np.array([6.0, 0.0, 0.0])
    rig = automatic_rig(joined(ball(2.0, 3000), ball(0.05, 300, (6.0, 0.0, 0.0))), drawing())
    away = centre - centres(rig.cameras)
    distance = np.linalg.norm(away, axis=1)
    near = (distance < 0.3) & (np.einsum("vx,vx->v", forwards(rig.cameras), away) > 0.9 * distance)
    assert near.sum() >= 8 and near[split_views(len(rig.cameras))[1]].any()
    assert not sample_scene(joined(ball(2.0, 3000), ball(0.4, 100, (2.0, 0.0, 0.0)))).things


def test_what_lies_around_another_is_seen_from_inside() -> None:
    source = joined(room(5.0), ball(0.2, 300, (1.0, 1.0, 0.0)))
    cameras = automatic_rig(source, drawing()).cameras
    away = np.linalg.norm(centres(cameras) - [1.0, 1.0, 0.0], axis=1)
    assert (away < 1.0).sum() >= 8 and (np.abs(centres(cameras)) < 4.9).all(axis=1).mean() > 0.7


def test_what_no_view_shows_well_has_close_ups() -> None:
    """A shell that is seen from outside, and a ball in it that touches it."""
    shell = fibonacci(6000)
    inner = fibonacci(250) * 0.3 + [0.0, 1.75, 0.0]
    source = make_splats(np.concatenate([2 * shell, inner]), np.full((6250, 3), 0.05), opacity=0.95)
    rig = automatic_rig(source, drawing())
    assert all(each.count >= 6 for each in rig.close_ups)
    places = np.array([each.place for each in rig.close_ups])
    eyes = centres([each.camera for each in rig.close_ups])
    assert np.linalg.norm(places - [0.0, 1.75, 0.0], axis=1).min() < 0.5
    assert (np.linalg.norm(eyes, axis=1) < 2).any()


@pytest.mark.parametrize("kind", ["object", "room", "both"])
def test_no_view_starts_inside_matter(kind: str) -> None:
    source = {"object": ball(), "room": room(), "both": joined(ball(0.8, 2500), room(5.0))}[kind]
    cameras, _ = placed(source, views=12, width=64, height=48)
    assert max(blocked(source, camera, 0.15) for camera in cameras) < 0.3


# Degree 1 alone is as strong from behind: it tells the axis, not the side.
@pytest.mark.parametrize(("eye", "degree"), [((6.0, 0.0, 1.0), 2), ((0.0, -5.0, 0.5), 3)])
def test_sh_tell_where_cameras_stood(eye: tuple[float, float, float], degree: int) -> None:
    source = with_sh(ball(1.5, 4000), np.array(eye), degree)
    cameras, note = placed(source, views=16, width=64, height=48)
    side = np.array(eye) / np.linalg.norm(eye)
    standing = centres(cameras) @ side / np.linalg.norm(centres(cameras), axis=1)
    assert np.mean(standing) > 0.5 and "SH are strong" in note
    blind, _ = placed(ball(1.5, 4000), views=16, width=64, height=48)
    assert np.mean(centres(blind) @ side / np.linalg.norm(centres(blind), axis=1)) < 0.3


def test_the_same_scene_gets_the_same_rig() -> None:
    first, second = (placed(room(), views=9)[0] for _ in range(2))
    assert [camera.name for camera in first] == [f"auto_{i:03d}" for i in range(9)] == sorted(c.name for c in first)
    for a, b in zip(first, second):
        np.testing.assert_array_equal(a.rotation, b.rotation)
        np.testing.assert_array_equal(a.translation, b.translation)
    assert {(c.width, c.height) for c in first} == {(640, 480)}
    assert 2 * math.degrees(math.atan(320 / first[0].fx)) == pytest.approx(65)
    for camera in first:
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
    # A larger rig has all views of a smaller one.
    few, _ = placed(room(), views=4)
    apart = np.abs(centres(few)[:, None] - centres(first)).max(axis=2) + np.abs(
        forwards(few)[:, None] - forwards(first)
    ).max(axis=2)
    assert apart.min(axis=1).max() < 1e-12


def test_threads_change_nothing(sample_dir: Path) -> None:
    code = (
        "import sys, hashlib; from flexgs_edge.run.run import open_run; from flexgs_edge.run.options import ViewOptions;"
        "run = open_run(sys.argv[1], ViewOptions(cameras='auto'), photos=False);"
        "poses = [(c.rotation.tobytes(), c.translation.tobytes()) for c in run.seen.cameras];"
        "print(hashlib.sha256(repr(poses).encode()).hexdigest())"
    )
    found = [
        subprocess.run(
            [sys.executable, "-c", code, str(sample_dir / "point_cloud.ply")],
            env={**os.environ, "OPENBLAS_NUM_THREADS": threads, "POCL_MAX_PTHREAD_COUNT": threads},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for threads in ("1", "2", "7")
    ]
    assert len(found[0]) > 60 and found[0] == found[1] == found[2]


def test_placing_views_is_quick() -> None:
    """Nearly all of the time is that of drawing candidates. They are counted: processor time depends on what else runs."""
    drawn: list[Camera] = []

    @contextmanager
    def counted(planes: dict[str, np.ndarray]) -> Iterator[Show]:
        with drawing()(planes) as show:

            def counting(camera: Camera) -> tuple[np.ndarray, np.ndarray]:
                drawn.append(camera)
                return show(camera)

            yield counting

    automatic_rig(ball(1.0, 1500), counted)
    assert 100 < len(drawn) < 500


def test_scale_and_place_do_not_matter() -> None:
    small, _ = placed(ball(), views=6)
    planes = ball().read(slice(0, 3000), list(FIELD))
    planes["means"] *= 1024
    planes["log_scales"] += np.float32(math.log(1024))
    large, _ = placed(MemorySource(planes, origin=np.array([5e6, -2e6, 0.0])), views=6)
    np.testing.assert_allclose(centres(large) - [5e6, -2e6, 0.0], centres(small) * 1024, rtol=1e-3, atol=1)


def test_what_cannot_be_looked_at() -> None:
    with pytest.raises(InputError, match="0 automatic views: expected at least 1"):
        automatic_rig(ball(), drawing(), views=0)


def test_a_camera_looks_where_it_is_told() -> None:
    for forward in ([1.0, 2.0, -0.5], [0.0, 0.0, 1.0], [0.0, 0.0, -3.0]):
        camera = look("a", np.array([1.0, 2.0, 3.0]), np.array(forward), np.array([0.0, 0.0, 1.0]), 64, 48, 50.0)
        np.testing.assert_allclose(camera.center, [1.0, 2.0, 3.0], atol=1e-12)
        np.testing.assert_allclose(camera.rotation[2], np.array(forward) / np.linalg.norm(forward), atol=1e-12)
        assert np.linalg.det(camera.rotation) == pytest.approx(1)
        assert camera.rotation[1] @ [0, 0, 1] <= 1e-12  # down is never up


def test_weighted_quantiles() -> None:
    values = np.array([[3.0, 1.0, 2.0], [0.0, 0.0, 5.0]])
    np.testing.assert_array_equal(weighted_quantiles(values, np.array([1.0, 1.0, 1.0]), [0.5]), [[2.0, 0.0]])
    np.testing.assert_array_equal(weighted_quantiles(values, np.array([0.0, 0.0, 1.0]), [0.1, 0.9]), [[2.0, 5.0]] * 2)


def test_sh_basis_is_orthonormal() -> None:
    basis = sh_basis(fibonacci(4000).T, 15)
    np.testing.assert_allclose(basis @ basis.T * 4 * math.pi / 4000, np.eye(15), atol=5e-3)


def held_out_drop(
    source: SceneSource, photos: Photos, held: list[int], scores: np.ndarray, choice: Choice
) -> tuple[float, float]:
    """Drop in PSNR (dB) against the photos, and PLY bytes over coded bytes."""
    renderer = Renderer(open_form("gpu" if default_device().type == "gpu" else "w16"), large_budget())

    def psnr(images: list[np.ndarray]) -> float:
        errors = [np.mean((np.clip(image, 0, 1) - photos.load(i)) ** 2) for image, i in zip(images, held)]
        return float(np.mean([-10 * math.log10(error) for error in errors]))

    with renderer.load(source) as scene:
        before = psnr([renderer.render(scene, photos.cameras[i]) for i in held])
    rows = select_rows(ranks_from_order(order_from_scores(scores)), choice, nonzero_sh(source))
    quantized = quantize_scene(source, *rows, PAPER)
    with renderer.load_quantized(quantized) as scene:
        after = psnr([renderer.render(scene, photos.cameras[i]) for i in held])
    renderer.release()
    size = quantized_bytes(quantized.count, quantized.sh_count, quantized.sh_degree, PAPER)
    return before - after, source.count * 248 / size


@pytest.mark.parametrize("scene", ["fox", "still_life"])
def test_real_scenes_are_ranked_nearly_as_by_their_own_poses(request: pytest.FixtureRequest, scene: str) -> None:
    folder: Path = request.getfixturevalue("fox_dir" if scene == "fox" else "sample_dir")
    source = PlySource(folder / "point_cloud.ply")
    photos = Photos.open(folder / "images", read_cameras(folder))
    train, held = split_views(len(photos.cameras))
    rig, _ = placed(source)
    scores = []
    for cameras in ([rig[i] for i in split_views(len(rig))[0]], [photos.cameras[i] for i in train]):
        renderer = Renderer(open_form("w16"), large_budget())
        with renderer.load(source) as loaded:
            scores.append(score_scene(renderer, loaded, source, cameras))
        renderer.release()
    drops = [held_out_drop(source, photos, held, score, Choice(200, 400)) for score in scores]
    assert drops[0][1] > 8 and drops[0][0] < 1.2, f"automatic {drops[0]}, by the real poses {drops[1]}"
    assert drops[0][0] < drops[1][0] + 0.4
