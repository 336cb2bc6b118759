"""`compress` of several scenes: one after the other, past those that fail."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import replace
from typing import Any

from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import InputError
from flexgs_edge.files import check_folder, check_writable
from flexgs_edge.io.formats import format_of
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.progress import LOG, SILENT, Progress
from flexgs_edge.report.batch_result import BatchItem, BatchResult
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.batch import FGS, StrPath, check_place, output_names, output_suffix, scenes_of
from flexgs_edge.run.clock import Stopwatch
from flexgs_edge.run.failure import INTERNAL, TRACEBACKS, failure_of
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, NO_PHOTOS, CompressOptions
from flexgs_edge.run.outputs import check_output

OF_ONE_SCENE: dict[str, tuple[object, ...]] = {
    "cameras": (None, AUTO_CAMERAS, NO_CAMERAS),
    "images": (None, NO_PHOTOS),
    "score_cache": (None,),
    "report": (None,),
    "resume": (False,),
}  # Options that belong to one scene, and their values that suit any scene


def compress_all(
    inputs: Sequence[StrPath] | StrPath,
    output: StrPath | None,
    options: CompressOptions | None = None,  # What the command line would say. Targets hold for each scene.
    progress: Progress = SILENT,  # bars on long work
    format: str | None = None,  # Suffix of the files, such as `.spz`. Default: `.fgs`.
    after: Callable[[BatchResult], object] | None = None,
    **words: Any,  # single options by the names of `CompressOptions`, such as `max_drop=0.5`
) -> BatchResult:
    """Compress several scenes into a folder; a scene that fails does not stop the others.

    `inputs`: scene files, model folders, and folders of scenes. A folder that is no scene stands for the scenes
    directly in it. `output`: the folder to write to, made if it is missing (None only in a dry run). Each file is named
    after its scene, with the suffix replaced. Scenes of the same name keep their suffix too, then get the names of
    their folders in front. `after`: called with the result so far after each scene, for those who want it even if the
    run is interrupted. Returns the result of each scene, or its error. Errors of single scenes are logged, not raised.
    Raises `InputError`: Before any work: if the folder cannot be written to, or an option does not fit several scenes
    or the format.
    """
    options = replace(options or CompressOptions(), **words)
    suffix = output_suffix(format)
    check_output(f"scene{suffix}", replace(options, dry_run=True))  # refuses options that do not fit the format
    scenes = scenes_of([inputs] if isinstance(inputs, (str, os.PathLike)) else inputs, output, suffix)
    if len(scenes) > 1:
        _check_options(options)
    names = output_names(scenes, suffix)
    if options.dry_run:
        batch = _Batch(scenes, names, after)  # compress takes the format from the name alone
        batch.check(False, options.force)
        batch.run(options, progress)
        return batch.result()
    folder = _check_folder(output)
    batch = _Batch(scenes, [os.path.join(folder, name) for name in names], after)
    with _made(folder):
        batch.check(True, options.force)
        batch.run(options, progress)
    return batch.result()


class _Batch:
    """Scenes, their files, and what has become of them.

    `scenes`, `files`: as many. `after`: called after each scene.
    """

    def __init__(
        self, scenes: Sequence[str], files: Sequence[str], after: Callable[[BatchResult], object] | None
    ) -> None:
        self.scenes, self.files, self.after = scenes, files, after
        self._clock = Stopwatch()
        self._done: dict[int, BatchItem] = {}

    def result(self) -> BatchResult:
        """The result so far."""
        items = tuple(self._done[index] for index in sorted(self._done))
        return BatchResult(items, len(self.scenes), self._clock.total)

    def check(self, writes: bool, force: bool) -> None:
        """Find the scenes that fail without any work: a folder without scenes, or a file that cannot be written."""
        sources = {os.path.realpath(scene) for scene in self.scenes}
        for index, (scene, file) in enumerate(zip(self.scenes, self.files, strict=True)):
            self._attempt(index, check_place, scene)
            if writes and index not in self._done:
                self._attempt(index, _check_file, file, sources, force)

    def run(self, options: CompressOptions, progress: Progress) -> None:
        """Compress the scenes that have not failed yet."""
        for index, (scene, file) in enumerate(zip(self.scenes, self.files, strict=True)):
            if index not in self._done:
                LOG.info("scene %d of %d: %s", index + 1, len(self.scenes), scene)
                self._attempt(index, compress, scene, file, options, progress)

    def _attempt(self, index: int, work: Callable[..., CompressResult | None], *arguments: Any) -> None:
        """Do some work for a scene. Its result or its error is what becomes of the scene."""
        scene = self.scenes[index]
        try:
            result = work(*arguments)
            if result is None:
                return
            item = BatchItem(scene, result)
        except Exception as error:  # a fault of ours as well: the other scenes can do without this one
            found = failure_of(error)
            item = BatchItem(scene, None, found.words, found.exit_code)
            LOG.error("%s: %s%s", scene, "" if found.exit_code == INTERNAL else "error: ", item.reason)
            TRACEBACKS.debug("%s", scene, exc_info=error)
        # The error with its frames is gone here. Cycles of references may still hold the scene's arrays, and the heap keeps
        # freed memory, which would count against the limit of the next scene.
        gc.collect()
        trim_heap()
        self._done[index] = item
        if self.after is not None:
            self.after(self.result())


def _check_file(file: str, sources: Container[str], force: bool) -> None:
    """Raise `InputError` unless a file can be written that is none of the inputs."""
    if os.path.realpath(file) in sources:
        raise InputError(f"{file}: this is one of the inputs; choose another folder or --format")
    check_writable(file, force)


def _check_options(options: CompressOptions) -> None:
    """Raise `InputError` for options that only one of several scenes could use."""
    for name, general in OF_ONE_SCENE.items():
        value = getattr(options, name)
        if value not in general:
            word = "--" + name.replace("_", "-") + ("" if value is True else f" {value}")
            raise InputError(f"{word} belongs to one scene: leave it out, or compress each scene on its own")


def _check_folder(output: StrPath | None) -> str:
    """The folder to write to, if that is possible."""
    if output is None or not os.fspath(output):
        raise InputError("-o OUT/ is missing: give the folder to write to, or --dry-run")
    name = os.fspath(output)
    names_file = name.lower().endswith((FGS, ".ply")) or format_of(name) is not None
    if names_file and not name.endswith(os.sep) and not os.path.isdir(name):
        raise InputError(
            f"-o {name}: several scenes, or a folder of them, need a folder, and this is the name of a file; write {name}/ to "
            "mean a folder, or give one scene"
        )
    check_folder(name, force=True)
    return name


@contextmanager
def _made(folder: str) -> Iterator[None]:
    """Make a folder if it is missing; remove it again if nothing was written to it."""
    new = not os.path.isdir(folder)
    try:
        if new:
            os.mkdir(folder)
    except OSError as error:
        raise InputError(f"-o {folder}: cannot make the folder ({error.strerror})") from error
    try:
        yield
    finally:
        if new:
            with suppress(OSError):  # something was written to it
                os.rmdir(folder)
