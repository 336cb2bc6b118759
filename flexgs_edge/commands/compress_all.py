"""`compress` of several scenes: which ones the inputs stand for; one after the other, past those that fail."""

import gc
import os
from collections import Counter
from collections.abc import Callable, Container, Iterator, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

from flexgs_edge.commands.compress import compress
from flexgs_edge.errors import INTERNAL, TRACEBACKS, InputError, failure_of
from flexgs_edge.files import check_folder, check_writable
from flexgs_edge.io.formats import WRITTEN, format_of
from flexgs_edge.io.model_folder import POINT_CLOUD
from flexgs_edge.memory.process import trim_heap
from flexgs_edge.progress import LOG, SILENT, Progress, Stopwatch
from flexgs_edge.report.results import BatchItem, BatchResult, CompressResult
from flexgs_edge.run.open_scene import GZ, SUFFIXES, scene_file
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, NO_PHOTOS, CompressOptions
from flexgs_edge.run.run import check_output

OF_ONE_SCENE: dict[str, tuple[object, ...]] = {
    "cameras": (None, AUTO_CAMERAS, NO_CAMERAS),
    "images": (None, NO_PHOTOS),
    "score_cache": (None,),
    "report": (None,),
    "keep_removed": (None,),
    "resume": (False,),
}  # Options that belong to one scene, and their values that suit any scene
StrPath = str | os.PathLike[str]
FGS = ".fgs"
COMPANIONS = (
    "cameras.json", "transforms.json", "cfg_args", "images", "sparse",
    *(f"{name}{end}" for name in ("cameras", "images", "points3D") for end in (".bin", ".txt")),
)  # fmt: skip
"""Names beside scenes that are no scenes and need no words."""
_SUFFIXES = tuple(each for each in SUFFIXES if each.startswith("."))
_ENDINGS = sorted((each + packed for each in _SUFFIXES for packed in ("", GZ)), key=len, reverse=True)
_NAMED = 5  # Most skipped names in one line of the log


def is_batch(inputs: Sequence[StrPath], output: StrPath | None) -> bool:
    """Whether a command has several scenes, or a folder to write to; raises `InputError` for a folder without access."""
    if len(inputs) != 1:
        return True
    if output is not None and (os.fspath(output).endswith(os.sep) or os.path.isdir(output)):
        return True
    return _is_collection(inputs[0]) and bool(_list(inputs[0])[0])


def scenes_of(inputs: Sequence[StrPath], output: StrPath | None, suffix: str) -> list[str]:
    """The scenes that the inputs stand for, in their order, each path once.

    A folder that is no scene stands for the scenes directly in it, by name: files of known suffixes, and folders that are
    scenes. Hidden files and companions are left out, and the log names other files and folders. A folder without scenes
    stays as it is, and `check_place` says why.
    """
    found: dict[str, str] = {}
    for each in inputs:
        places = [os.fspath(each)]
        if _is_collection(each):
            same = output is not None and os.path.realpath(output) == os.path.realpath(each)
            with suppress(InputError):
                inside, skipped = _list(each, suffix if same else None)
                places = inside or places
                if skipped:
                    more = f" and {len(skipped) - _NAMED} more" if len(skipped) > _NAMED else ""
                    LOG.info("%s: skipped %s%s", os.fspath(each), ", ".join(skipped[:_NAMED]), more)
        for place in places:
            found.setdefault(os.path.abspath(place), place)
    return list(found.values())


def _is_collection(place: StrPath) -> bool:
    """Whether this is a folder, but neither a model folder nor one of SOG pictures.

    A folder with a `point_cloud.ply` is a model folder, unless other scenes than results of ours lie beside that file.
    """
    if not os.path.isdir(place):
        return False
    try:
        scene = scene_file(place)
    except InputError:
        return True
    if scene != Path(place) / POINT_CLOUD:
        return False
    with suppress(InputError):
        return len(_list(place, FGS)[0]) > 1
    return False


def _list(folder: StrPath, written: str | None = None) -> tuple[list[str], list[str]]:
    """Paths of the scenes in a folder, and names of what else is there. Files that end in `written` are no scenes."""
    try:
        names = sorted(os.listdir(folder))
    except OSError as error:
        raise InputError(f"{folder}: cannot list the folder ({error.strerror})") from error
    found, skipped = [], []
    for name in names:
        place = os.path.join(folder, name)
        if name.startswith(".") or name in COMPANIONS:
            continue
        if os.path.isdir(place):
            known = not _is_collection(place)
        else:
            old = written is not None and name.lower().endswith(written)
            known = _ending(name) != "" and not old and os.path.isfile(place)
        if known:
            found.append(place)
        else:
            skipped.append(name)
    return found, skipped


def check_place(scene: StrPath) -> None:
    """Raise `InputError` for a folder that has no scenes or cannot be listed."""
    if _is_collection(scene):
        _list(scene)
        raise InputError(
            f"{scene}: no scene to compress in this folder: expected files that end in {', '.join(_SUFFIXES)}, or folders "
            f"with {POINT_CLOUD}, point_cloud/iteration_*, meta.json or lod-meta.json"
        )


def output_names(scenes: Sequence[str], suffix: str) -> list[str]:
    """A file name for each scene: its own, with the suffix replaced.

    Scenes of the same name keep their suffix as well (`a.ply.fgs`, `a.spz.fgs`). If that does not tell them apart, the
    names of their folders come first (`left-a.ply.fgs`, `right-a.ply.fgs`). The order of the scenes does not matter.

    >>> output_names(["x/a.ply", "x/b.ply"], ".fgs")
    ['a.fgs', 'b.fgs']
    >>> output_names(["x/a.ply", "x/a.spz", "x/b.ply"], ".fgs")
    ['a.ply.fgs', 'a.spz.fgs', 'b.fgs']
    >>> output_names(["x/a.ply", "y/a.ply"], ".fgs")
    ['x-a.ply.fgs', 'y-a.ply.fgs']

    Raises `InputError` if two names stay the same.
    """
    parts = [_parts(scene) for scene in scenes]
    depths = [0] * len(scenes)
    while True:
        names = [_name(part, depth) + suffix for part, depth in zip(parts, depths, strict=True)]
        count = Counter(names)
        same = [index for index, name in enumerate(names) if count[name] > 1]
        if not same:
            return names
        if all(depths[index] > len(parts[index]) for index in same):
            raise InputError(
                f"{', '.join(scenes[index] for index in same)}: all would be written as {names[same[0]]}; "
                "compress each on its own"
            )
        for index in same:
            depths[index] += 1


def _parts(scene: str) -> tuple[str, ...]:
    """The names on the way to a scene. The last is that of the scene: of a folder with `meta.json`, not of that file."""
    place = Path(os.path.abspath(scene))
    if place.name.lower().endswith("meta.json") and not place.is_dir():
        place = place.parent
    return place.parts[1:] or ("scene",)


def _name(parts: tuple[str, ...], depth: int) -> str:
    """The name at a depth: 0 is without the suffix, 1 with it, and each further one adds a folder in front."""
    if depth > 0:
        return "-".join(parts[-depth:])
    return parts[-1][: len(parts[-1]) - len(_ending(parts[-1]))] or parts[-1]


def _ending(name: str) -> str:
    """The known suffix of a file name, with `.gz` if it is packed; "" if there is none."""
    lower = name.lower()
    return next((each for each in _ENDINGS if lower.endswith(each)), "")


def output_suffix(word: str | None) -> str:
    """The suffix that `--format` names, with its dot; raises `InputError` for one that is not written."""
    if word is None:
        return FGS
    suffix = f".{word.lower().lstrip('.')}"
    if suffix not in (FGS, *WRITTEN):
        raise InputError(f"--format {word}: expected one of {', '.join((FGS, *WRITTEN))}")
    return suffix


def single_output(output: StrPath | None, word: str | None, dry_run: bool) -> StrPath | None:
    """The file of a single scene, which `--format` must agree with. A dry run without a file gets its format from it."""
    if word is None:
        return output
    suffix = output_suffix(word)
    if output is None:
        return f"scene{suffix}" if dry_run else None
    if not os.fspath(output).lower().endswith(suffix):
        raise InputError(f"--format {word} with -o {output}: the name does not end in {suffix}; leave --format out")
    return output


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

    `inputs`: scene files, model folders, and folders of scenes. A folder that is no scene stands for the scenes directly in it.
    `output`: the folder to write to, made if it is missing (None only in a dry run). Each file is named after its scene, with
    the suffix replaced. Scenes of the same name keep their suffix too, then get the names of their folders in front. `after`:
    called with the result so far after each scene, for those who want it even if the run is interrupted. Returns the result of
    each scene, or its error. Errors of single scenes are logged, not raised. Raises `InputError`: Before any work: if the
    folder cannot be written to, or an option does not fit several scenes or the format.
    """
    options = replace(options or CompressOptions(), **words)
    suffix = output_suffix(format)
    check_output(f"scene{suffix}", replace(options, dry_run=True))  # refuses options that do not fit the format
    scenes = scenes_of([inputs] if isinstance(inputs, (str, os.PathLike)) else inputs, output, suffix)
    if len(scenes) > 1:
        _check_options(options)
    names = output_names(scenes, suffix)
    folder = "" if options.dry_run else _check_folder(output)  # compress takes the format from the name alone
    batch = _Batch(scenes, [os.path.join(folder, name) for name in names], after)
    with _made(folder) if folder else nullcontext():
        batch.check(bool(folder), options.force)
        batch.run(options, progress)
    return batch.result()


class _Batch:
    """Scenes, their files, and what has become of them. `scenes`, `files`: as many. `after`: called after each scene."""

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
