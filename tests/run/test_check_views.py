"""Views that do not belong to their scene are refused, and the cause is named."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageFilter

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.conventions import other_conventions
from flexgs_edge.commands.compress import compress
from flexgs_edge.commands.evaluate import evaluate
from flexgs_edge.errors import InputError
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import CompressOptions, ViewOptions
from flexgs_edge.run.run import Run, frame_warnings, open_run
from flexgs_edge.run.view_set import GivenViews
from flexgs_edge.scene.source import MemorySource

WIDTH = 120
Opened = tuple[Run[ViewOptions], Renderer]
Load = Callable[[int], np.ndarray]


class MadePhotos:
    """Photos that a function makes."""

    def __init__(self, load: Load) -> None:
        self.load = load


@pytest.fixture(scope="module")
def opened(sample_dir: Path) -> Iterator[Opened]:
    """The bundled scene with small views."""
    run = open_run(sample_dir / "point_cloud.ply", ViewOptions(resolution=WIDTH))
    with open_renderer(run) as renderer:
        yield run, renderer


def checked(
    opened: Opened, cameras: list[Camera] | None = None, load: Load | None = None, trusted: bool = False
) -> tuple[str, ...]:
    """Warnings of the check with other cameras or photos."""
    run, renderer = opened
    views = run.seen
    photos: Any = views.photos if load is None else MadePhotos(load)
    changed = replace(run, views=replace(views, cameras=cameras or views.cameras, photos=photos))
    return check_views(changed, renderer, trusted).warnings


def photo(opened: Opened, index: int) -> np.ndarray:
    photos = opened[0].seen.photos
    assert photos is not None
    return photos.load(index)


def test_right_views_pass(opened: Opened) -> None:
    assert checked(opened) == ()


@pytest.mark.parametrize("count", [1, 2, 5, 16])
def test_few_right_views_pass(opened: Opened, count: int) -> None:
    some = np.random.default_rng(count).permutation(len(opened[0].seen.cameras))[:count].tolist()
    assert checked(opened, [opened[0].seen.cameras[i] for i in some], lambda i: photo(opened, some[i])) == ()


@pytest.mark.parametrize(
    "change",
    [
        lambda image, index: np.clip(image**2.2 * 2.0 ** (index % 3 - 1), 0, 1) ** (1 / 2.2),
        lambda image, index: image * np.float32([1.0, 0.8, 0.6]),
        lambda image, index: np.rint(image * 0.1 * 255) / 255,
        lambda image, index: (
            np.asarray(
                Image.fromarray((image * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(0.01 * WIDTH)),
                np.float32,
            )
            / 255
        ),
        lambda image, index: np.clip(image + np.random.default_rng(index).normal(0, 0.05, image.shape), 0, 1),
    ],
    ids=["exposure", "white balance", "dark", "blurred", "noisy"],
)
def test_bad_photos_of_right_views_pass(opened: Opened, change: Callable[[np.ndarray, int], np.ndarray]) -> None:
    assert checked(opened, load=lambda i: change(photo(opened, i), i).astype(np.float32)) == ()


CONVENTIONS = list(other_conventions())


@pytest.mark.parametrize("convention", [*CONVENTIONS[::16], *CONVENTIONS[-3:]], ids=lambda convention: convention.words)
def test_each_other_convention_is_refused_and_taken_back(opened: Opened, convention: Any) -> None:
    cameras = [convention.applied(camera)[0] for camera in opened[0].seen.cameras]
    mirrored = convention.applied(cameras[0])[1]
    load = (lambda i: photo(opened, i)[:, ::-1]) if mirrored else None
    with pytest.raises(InputError, match=r"do not resemble their photo.*The cameras fit if"):
        checked(opened, cameras, load)


def test_the_frame_that_fits_is_one_that_frame_takes(opened: Opened, sample_dir: Path) -> None:
    flip = np.diag([1.0, -1.0, -1.0])
    cameras = [replace(c, rotation=c.rotation @ flip) for c in opened[0].seen.cameras]
    with pytest.raises(InputError, match="--frame RUB"):
        checked(opened, cameras)
    turned = open_run(sample_dir / "point_cloud.ply", ViewOptions(resolution=WIDTH, frame="RUB"))
    assert checked((turned, opened[1]), cameras) == ()


@pytest.mark.parametrize("places", [1, -1, 3])
def test_photos_of_other_cameras_name_the_shift(opened: Opened, places: int) -> None:
    count = len(opened[0].seen.cameras)
    words = f"fits the photo {abs(places)} places? {'before' if places > 0 else 'after'} its own"
    with pytest.raises(InputError, match=words):
        checked(opened, load=lambda i: photo(opened, (i + places) % count))


def test_masks_are_named(opened: Opened) -> None:
    def mask(index: int) -> np.ndarray:
        return np.repeat((photo(opened, index).mean(axis=2, keepdims=True) > 0.4).astype(np.float32), 3, axis=2)

    with pytest.raises(InputError, match="masks or depth maps"):
        checked(opened, load=mask)


def test_a_smaller_world_is_refused(opened: Opened) -> None:
    cameras = [replace(c, translation=0.24 * c.translation) for c in opened[0].seen.cameras]
    with pytest.raises(InputError, match="another frame"):
        checked(opened, cameras)


def test_some_wrong_photos_are_a_warning(opened: Opened) -> None:
    warnings = checked(opened, load=lambda i: photo(opened, 40 if i == 0 else i))
    assert (
        len(warnings) == 1 and "1 of 15 compared views" in warnings[0] and opened[0].seen.cameras[0].name in warnings[0]
    )


def test_views_that_see_nothing_are_warned_of_without_photos(opened: Opened) -> None:
    run, renderer = opened
    away = [replace(c, rotation=np.diag([-1.0, 1.0, -1.0]) @ c.rotation) for c in run.seen.cameras]
    far = [replace(c, translation=np.diag([-1.0, 1.0, -1.0]) @ c.translation + [0, 0, -1e6]) for c in away]
    blind = replace(run, views=replace(run.seen, cameras=far, photos=None))
    assert frame_warnings(run.seen, run.scene) == ()
    assert "nothing of the scene in sight" in frame_warnings(blind.seen, run.scene)[0]
    (words,) = check_views(blind, renderer, trusted=False).warnings
    assert "15 of 15 compared views show nothing but one colour" in words


def test_cameras_in_matter_are_refused_without_photos(opened: Opened) -> None:
    run, renderer = opened
    wall = {
        "means": np.zeros((3, 1), np.float32),
        "log_scales": np.full((3, 1), 6.0, np.float32),
        "quats": np.array([[1.0], [0.0], [0.0], [0.0]], np.float32),
        "opacity_logits": np.full((1, 1), 9.0, np.float32),
        "sh_dc": np.ones((3, 1), np.float32),
    }
    inside = replace(run.of_source(MemorySource(wall)), views=replace(run.seen, photos=None))
    with pytest.raises(InputError, match="stand in matter"):
        check_views(inside, renderer, trusted=False)


def test_compress_stops_and_evaluate_warns(opened: Opened, sample_dir: Path, tmp_path: Path) -> None:
    cameras = opened[0].seen.cameras
    images = [(photo(opened, (i + 1) % len(cameras)) * 255).astype(np.uint8) for i in range(len(cameras))]
    given = GivenViews(cameras, images)
    options = CompressOptions(effort="fast", resolution=WIDTH)
    out = tmp_path / "a.fgs"
    with pytest.raises(InputError, match="--trust-views"):
        compress(sample_dir / "point_cloud.ply", out, options, given=given)
    assert not out.exists()
    folder = tmp_path / "images"
    folder.mkdir()
    for i, camera in enumerate(cameras):
        Image.fromarray(images[i]).save(folder / f"{Path(camera.name).stem}.png")
    ply = sample_dir / "point_cloud.ply"
    found = evaluate(ply, ply, cameras=str(sample_dir / "cameras.json"), images=str(folder))
    assert any("1 place before" in words for words in found.warnings)
    assert any("1 place before" in words for words in found.to_json()["warnings"])
