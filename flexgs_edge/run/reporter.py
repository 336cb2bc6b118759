"""`--report DIR`: collect pictures and figures during a run, and write the page and the record at the end."""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

from flexgs_edge.errors import InputError
from flexgs_edge.files import atomic_write, check_writable
from flexgs_edge.goals.target import Target
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.quality.view_quality import Quality
from flexgs_edge.render.device_scene import DeviceScene
from flexgs_edge.report.as_json import json_text
from flexgs_edge.report.material import Live, Material, Rig, Shot
from flexgs_edge.report.pages import compress_page, evaluate_page
from flexgs_edge.report.results import CompressResult, EvaluateResult
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.contents import contents
from flexgs_edge.run.inputs import CheckedScene
from flexgs_edge.run.judge import Judge
from flexgs_edge.run.open_scene import is_fgs
from flexgs_edge.run.pictures import draw_shots, rig_of, shots_bytes
from flexgs_edge.run.view_set import ViewSet

LOG = logging.getLogger("flexgs_edge")

PAGE, RECORD = "index.html", "result.json"


class Reporter:
    """Collects the contents of a report during a run, and writes them at the end.

    `folder`: created at the end if it does not exist. The constructor only checks that it can be written. `force`:
    overwrite an earlier report. Raises `InputError` if the report cannot be written there.
    """

    def __init__(self, folder: str | Path, force: bool) -> None:
        if not os.fspath(folder):
            raise InputError("--report: expected a folder, found nothing")
        self.folder, self.force = Path(folder), force
        self._shots: tuple[Shot, ...] = ()
        self._rig: Rig | None = None
        self._contents: dict[str, Any] | None = None
        self._live: Live | None = None
        self._check()

    @classmethod
    def maybe(cls, folder: str | Path | None, force: bool) -> Reporter | None:
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
        self, judge: Judge, scene: DeviceScene, quality: Quality, clock: Stopwatch, progress: Progress = SILENT
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

    def show_live(self, make: Callable[[int], Live]) -> None:
        """Put live scenes beside the pictures; `make` gets the camera of the first picture."""
        if self._shots:
            self._live = make(self._shots[0].camera)

    def see_cameras(self, views: ViewSet, scene: CheckedScene) -> None:
        """Keep the camera poses for the plans."""
        self._rig = rig_of(views, scene.source)

    def write(self, result: CompressResult | EvaluateResult, target: Target | None = None) -> Path:
        """Write the page and the record: both, or neither if writing fails. Returns the path of the page."""
        material = Material(self._shots, self._rig, self._contents, target, self._live)
        words = (
            compress_page(result, material) if isinstance(result, CompressResult) else evaluate_page(result, material)
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
