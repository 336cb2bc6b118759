"""`--report DIR`: collect pictures and figures during a run, and write the page and the record at the end."""

import io
import os
import tempfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, check_writable
from flexgs_edge.goals.target import Target
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import LOG, SILENT, Progress, Stopwatch
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.report import pages
from flexgs_edge.report.as_json import json_text
from flexgs_edge.report.results import CompressResult, EvaluateResult
from flexgs_edge.run.contents import contents
from flexgs_edge.run.open_scene import is_fgs
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.view_set import ViewSet

MOST_SHOTS = 5
"""A report shows pictures of at most this many views: the worst, the median, the best, and one between each two."""
MOST_WIDTH = 800  # Wider pictures are scaled down to this many pixels: sharp on a phone, and a page of a few MB at most
LAYERS = 5  # Pictures per view: original, compressed, error map, map of FLIP, photo
PIXEL_BYTES = 1
"""Bytes per pixel that we reserve for an encoded picture. Only noise takes more: docs/results/tuning.md#memory"""
JPEG_QUALITY = 95
"""High enough that pictures differ by our compression and not by JPEG: docs/results/tuning.md#jpeg_quality"""
ERROR_QUALITY = 85
PAGE, RECORD = "index.html", "result.json"


def shown_size(camera: Camera) -> tuple[int, int]:
    """Width and height of a view's pictures."""
    if camera.width <= MOST_WIDTH:
        return camera.width, camera.height
    return MOST_WIDTH, max(1, round(camera.height * MOST_WIDTH / camera.width))


def shots_bytes(cameras: Sequence[Camera]) -> int:
    """Bytes to reserve for the encoded pictures of a report on `cameras`."""
    sizes = sorted((width * height for width, height in map(shown_size, cameras)), reverse=True)
    return LAYERS * PIXEL_BYTES * sum(sizes[:MOST_SHOTS])


def chosen_ranks(count: int) -> list[int]:
    """Ranks of the views to show, counted from the worst view.

    >>> chosen_ranks(10), chosen_ranks(2), chosen_ranks(0)
    ([0, 2, 4, 6, 9], [0, 1], [])
    """
    most = min(count, MOST_SHOTS)
    return [i * (count - 1) // max(most - 1, 1) for i in range(most)]


def draw_shots(
    judge: QualityEvaluator, scene: DeviceScene, quality: Quality, progress: Progress = SILENT
) -> tuple[pages.Shot, ...]:
    """Draw and encode the pictures of some views, the worst view first."""
    order = quality.by_loss
    ranks = chosen_ranks(len(order))
    shots = []
    for rank in progress.track(ranks, "drawing pictures", len(ranks)):
        view = order[rank]
        image, original, photo = judge.images(scene, view)
        width, height = shown_size(judge.cameras[view])
        shots.append(
            pages.Shot(
                view=view,
                camera=judge.indices[view],
                rank=rank,
                of=len(order),
                width=width,
                height=height,
                original=encode(original, (width, height)),
                compressed=encode(image, (width, height)),
                error=encode_map(pages.error_map(image, original), (width, height)),
                flip=encode_map(np.minimum(judge.flip_map(image, original) / pages.FLIP_SCALE, 1.0), (width, height)),
                photo=None if photo is None else encode(photo, (width, height)),
            )
        )
    return tuple(shots)


def encode(image: np.ndarray, size: tuple[int, int], quality: int = JPEG_QUALITY, short: bool = False) -> bytes:
    """Encode [H, W, 3] f32 in [0, 1] as JPEG, scaled down to `size` by area. Chroma keeps its full resolution, unless `short`."""
    from PIL import Image

    pixels = np.rint(np.clip(image, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if picture.size != size:
        picture = picture.resize(size, Image.Resampling.BOX)
    out = io.BytesIO()
    picture.save(out, "JPEG", quality=quality, subsampling=2 if short else 0, optimize=short, progressive=short)
    return out.getvalue()


def encode_map(errors: np.ndarray, size: tuple[int, int]) -> bytes:
    """Encode a map of errors between two renders, [H, W] f32 from 0 to 1, as JPEG.

    The map comes at full size and is scaled down here: averaging the pictures first would hide errors.
    """
    from PIL import Image

    if errors.shape != size[::-1]:
        errors = np.asarray(Image.fromarray(np.ascontiguousarray(errors)).resize(size, Image.Resampling.BOX))
    return encode(pages.ramp()[np.rint(errors * 255.0).astype(np.uint8)] / np.float32(255.0), size, ERROR_QUALITY)


class Reporter:
    """Collects the contents of a report during a run, and writes them at the end.

    `folder`: created at the end if it does not exist. The constructor only checks that it can be written. `force`:
    overwrite an earlier report. Raises `InputError` if the report cannot be written there.
    """

    def __init__(self, folder: str | Path, force: bool) -> None:
        if not os.fspath(folder):
            raise InputError("--report: expected a folder, found nothing")
        self.folder, self.force = Path(folder), force
        self._shots: tuple[pages.Shot, ...] = ()
        self._contents: dict[str, Any] | None = None
        self._live: pages.Live | None = None
        self._cleaned: pages.Cleaned | None = None
        self._check()

    @classmethod
    def maybe(cls, folder: str | Path | None, force: bool) -> "Reporter | None":
        """Create a reporter, or return `None` if no report is asked for."""
        return None if folder is None else cls(folder, force)

    def _check(self) -> None:
        folder = Path(os.path.realpath(self.folder))
        try:
            exists, plain, parent = folder.exists(), folder.is_dir(), folder.parent.is_dir()
        except OSError as error:
            raise InputError(f"--report {self.folder}: cannot write there ({error.strerror})") from error
        if exists and not plain:
            raise InputError(f"--report {self.folder}: expected a folder, found a file")
        if not parent:
            raise InputError(f"--report {self.folder}: the folder {folder.parent} does not exist; make it first")
        if not os.access(folder if exists else folder.parent, os.W_OK | os.X_OK):
            raise InputError(f"--report {self.folder}: no right to write there")
        if exists:
            for name in (PAGE, RECORD):
                check_writable(folder / name, self.force)

    def reserve(self, budget: MemoryBudget, views: ViewSet) -> None:
        """Reserve the memory of the pictures before any work, so that too small a limit fails at once."""
        budget.take("pictures of the report", shots_bytes(views.of(views.held_out or views.train)))

    def look(
        self,
        judge: QualityEvaluator,
        scene: DeviceScene,
        quality: Quality,
        clock: Stopwatch,
        progress: Progress = SILENT,
    ) -> None:
        """Draw the pictures of a decoded scene whose quality `judge` has just measured."""
        with clock.stage("pictures"):
            self._shots = draw_shots(judge, scene, quality, progress)

    def read_contents(self, path: str | Path) -> None:
        """Read the bytes per channel of a finished `.fgs`. Other formats are skipped: `info` knows no channels of theirs."""
        if is_fgs(Path(path)):
            self._contents = contents(Path(path)).to_json()

    def read_contents_of(self, write: Callable[[Path], object]) -> None:
        """Read the bytes per channel in a dry run: `write` writes a temporary file, which is then removed."""
        with tempfile.TemporaryDirectory(prefix="flexgs-") as folder:
            place = Path(folder) / "dry-run.fgs"
            write(place)
            self.read_contents(place)

    def show_cleaned(self, camera: Camera, before: np.ndarray, after: np.ndarray, removed: np.ndarray) -> None:
        """Show a view of a scene before and after a cleaning, and of what went: [H, W, 3] f32 each."""
        width, height = size = shown_size(camera)
        self._cleaned = pages.Cleaned(
            camera.name, width, height, *(encode(image, size) for image in (before, after, removed))
        )

    def show_live(self, make: Callable[[int], pages.Live]) -> None:
        """Put live scenes beside the pictures; `make` gets the camera of the first picture."""
        if self._shots:
            self._live = make(self._shots[0].camera)

    def write(self, result: CompressResult | EvaluateResult, target: Target | None = None) -> Path:
        """Write the page and the record: both, or neither if writing fails. Returns the path of the page."""
        material = pages.Material(self._shots, self._contents, target, self._live, self._cleaned)
        words = (
            pages.compress_page(result, material)
            if isinstance(result, CompressResult)
            else pages.evaluate_page(result, material)
        )
        made = not self.folder.exists()
        try:
            try:
                self.folder.mkdir(exist_ok=True)
            except OSError as error:
                raise InputError(f"--report {self.folder}: cannot make the folder ({error.strerror})") from error
            place = self.folder / PAGE
            with atomic_write(self.folder / RECORD, self.force) as record, atomic_write(place, self.force) as page:
                record.write(json_text(result.to_json()).encode())
                # Flush the record before the page gets its name: on a full disk no page may stand without its record.
                record.flush()
                page.write(words.encode())
        except BaseException:
            if made:
                with suppress(OSError):
                    self.folder.rmdir()
            raise
        LOG.info("wrote the report %s", place)
        return place
