"""Count how many views that do not fit their scene are refused, and how many good ones pass.

    python -m benchmarks.check_views [FOLDER ...]

Each folder has `point_cloud.ply`, `cameras.json` and `images/`. Default: the bundled scene, and fox and figure of
`FLEXGS_SCENES`.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageFilter

from benchmarks.figures import SCENES_DIR
from benchmarks.harness import ROOT
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.cameras.conventions import other_conventions
from flexgs_edge.errors import InputError
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.run.check_views import check_views
from flexgs_edge.run.open_renderer import open_renderer
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.run.run import Run, open_run

GOOD = 67
"""Good runs a scene: 200 over three scenes."""
Load = Callable[[int], np.ndarray]
Change = Callable[[np.ndarray, int], np.ndarray]


class MadePhotos:
    """Photos that a function makes."""

    def __init__(self, load: Load) -> None:
        self.load = load


def misfits(cameras: list[Camera], photo: Load, other: Load) -> Iterator[tuple[str, list[Camera], Load]]:
    """Views that do not fit, by name."""
    for convention in other_conventions():
        turned = [convention.applied(camera) for camera in cameras]
        mirrored = turned[0][1]
        load: Load = (lambda i: photo(i)[:, ::-1]) if mirrored else photo
        yield convention.words, [camera for camera, _ in turned], load
    yield "world scaled by .24", [replace(c, translation=0.24 * c.translation) for c in cameras], photo
    yield "mirrored photos", cameras, lambda i: photo(i)[:, ::-1]
    yield "photos shifted by 1", cameras, lambda i: photo((i + 1) % len(cameras))
    yield "photos shifted by -1", cameras, lambda i: photo(i - 1)
    yield "photos of another scene", cameras, other
    twice = [replace(c, fx=2 * c.fx, fy=2 * c.fy, cx=2 * c.cx, cy=2 * c.cy) for c in cameras]
    yield "cameras of photos twice as large", twice, photo
    yield (
        "masks",
        cameras,
        lambda i: np.repeat((photo(i).mean(axis=2, keepdims=True) > 0.4).astype(np.float32), 3, axis=2),
    )


def changes(rng: np.random.Generator) -> list[Change]:
    """What good photos suffer: nothing, exposure of up to a stop, white balance, darkness, blur, noise."""
    stops, gains = rng.uniform(-1, 1, 1000), rng.uniform(0.7, 1, (1000, 3)).astype(np.float32)

    def blurred(image: np.ndarray, index: int) -> np.ndarray:
        radius = 0.01 * image.shape[1]
        picture = Image.fromarray((image * 255).astype(np.uint8)).filter(ImageFilter.GaussianBlur(radius))
        return np.asarray(picture, np.float32) / 255

    return [
        lambda image, index: image,
        lambda image, index: np.clip(image**2.2 * 2.0 ** stops[index], 0, 1) ** (1 / 2.2),
        lambda image, index: image * gains[index],
        lambda image, index: np.rint(image * 0.15 * 255) / 255,
        blurred,
        lambda image, index: np.clip(image + np.random.default_rng(index).normal(0, 0.05, image.shape), 0, 1),
    ]


def verdict(run: Run[Any], renderer: Renderer, cameras: list[Camera], load: Load) -> str:
    """`""` if the views pass, else the warning or the error."""
    photos: Any = MadePhotos(lambda i: load(i).astype(np.float32))
    try:
        return " ".join(
            check_views(replace(run, views=replace(run.seen, cameras=cameras, photos=photos)), renderer, False).warnings
        )
    except InputError as error:
        return f"refused: {error}"


def measure(folder: Path, elsewhere: Path, resolution: int, with_misfits: bool) -> None:
    """Print what becomes of misfits and of good views of one scene."""
    rng = np.random.default_rng(1)
    run = open_run(folder / "point_cloud.ply", ViewOptions(resolution=resolution))
    views, others = run.seen, open_run(elsewhere / "point_cloud.ply", ViewOptions(resolution=resolution)).seen
    assert views.photos is not None and others.photos is not None
    photo, strange = views.photos.load, others.photos.load

    def other(i: int) -> np.ndarray:
        shape = (views.cameras[i].width, views.cameras[i].height)
        image = Image.fromarray((strange(i % len(others.cameras)) * 255).astype(np.uint8)).resize(shape)
        return np.asarray(image, np.float32) / 255

    with open_renderer(run) as renderer:
        start = time.perf_counter()
        assert verdict(run, renderer, views.cameras, photo) == ""
        print(f"{folder.name}: right views at width {resolution}: {time.perf_counter() - start:.2f} s", flush=True)
        if with_misfits:
            cases = misfits(views.cameras, photo, other)
            found = {name: verdict(run, renderer, cameras, load) for name, cameras, load in cases}
            refused = [name for name, words in found.items() if words.startswith("refused")]
            print(f"{folder.name}: {len(refused)} of {len(found)} misfits refused", flush=True)
            for name, words in found.items():
                if name not in refused or "world's x" not in name:
                    print(f"  {name}: {words[:160]}", flush=True)
        wrong = []
        count = GOOD // 2 + int(with_misfits)
        for number in range(count):
            some = np.sort(rng.permutation(len(views.cameras))[: int(rng.integers(5, 51))]).tolist()
            change = changes(rng)[number % 6]

            def load(i: int, some: list[int] = some, change: Change = change) -> np.ndarray:
                return change(photo(some[i]), some[i])

            words = verdict(run, renderer, views.of(some), load)
            if words:
                wrong.append(f"{len(some)} views, change {number % 6}: {words[:160]}")
        refused = [words for words in wrong if ": refused" in words]
        print(
            f"{folder.name}: {len(refused)} of {count} good runs refused, {len(wrong) - len(refused)} warned",
            flush=True,
        )
        for words in wrong:
            print("  " + words)


if __name__ == "__main__":
    given = [Path(word) for word in sys.argv[1:]] or [
        ROOT / "samples" / "still_life",
        SCENES_DIR / "fox",
        SCENES_DIR / "figure",
    ]
    for at, place in enumerate(given):
        for width, whole in ((1600, True), (200, False)):
            measure(place, given[at - 1], width, whole)
