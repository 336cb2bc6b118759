"""Compress scenes to files or bytes, and decode them."""

import os
import tempfile
import weakref
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from flexgs_edge.api.cameras import Cameras
from flexgs_edge.api.scene import Scene
from flexgs_edge.api.words import CompressWords, StrPath
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.commands import compress as command
from flexgs_edge.errors import InputError, brief
from flexgs_edge.progress import SILENT, Progress
from flexgs_edge.report.results import CompressResult
from flexgs_edge.run.inputs import checked_scene
from flexgs_edge.run.options import CompressOptions
from flexgs_edge.run.view_set import MEMORY, GivenViews

if TYPE_CHECKING:
    from typing_extensions import Unpack


def compress(
    scene: Scene | StrPath,
    output: StrPath | None,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    *,
    cameras: Sequence[Camera] | StrPath | None = None,
    images: StrPath | Sequence[NDArray[np.uint8]] | None = None,
    **words: "Unpack[CompressWords]",
) -> CompressResult:
    """Compress a scene to the smallest file that meets a target.

    Parameters
    ----------
    scene : Scene or path
        A scene, a scene file (`.ply`, `.fgs`, `.spz`, `.sog`, `.compressed.ply`), or INRIA's model folder.
    output : path or None
        The `.fgs`, `.spz`, `.sog` or `.compressed.ply` to write. None is allowed in a dry run, and then means a `.fgs`.
    options : CompressOptions, optional
        Options as on the command line. Default: lose at most 1 dB.
    progress : Progress, optional
        Shows bars during long work. Default: none.
    cameras : Cameras or path, optional
        Cameras, a camera file, `auto` or `none`. Default: the cameras beside the scene, else `auto`.
    images : path or sequence of np.ndarray, optional
        Folder of photos, `none`, or one array [H, W, 3] or [H, W, 4] per camera. Arrays are in the order of
        `cameras`; for cameras from a file, in order of name. Default: the photos beside the scene, if its own cameras are
        used.
    **words
        Single options, by the names of `CompressOptions`, such as `max_drop=0.5`.

    Returns
    -------
    CompressResult
        Sizes, quality of the decoded file, every step of the search, and times.

    Raises
    ------
    FlexGSError
        `InputError`, `TargetError`, `DeviceError` or `BudgetError`. No partly written file is left behind.
    """
    opened = scene.checked if isinstance(scene, Scene) else scene
    named: dict[str, Any] = {}
    given = GivenViews()
    if isinstance(cameras, (str, os.PathLike)):
        named["cameras"] = os.fspath(cameras)
    elif cameras is not None:
        path = cameras.path if isinstance(cameras, Cameras) else None
        given = replace(given, cameras=_listed("cameras", cameras, Camera), cameras_from=path or MEMORY)
    if isinstance(images, (str, os.PathLike)):
        named["images"] = os.fspath(images)
    elif images is not None:
        given = replace(given, images=_listed("images", images, np.ndarray))
    return command.compress(opened, output, options, progress, given, **named, **words)


def _listed(name: str, values: Iterable[Any], kind: type) -> list[Any]:
    """The values of a sequence or a generator, all of one kind."""
    if not isinstance(values, Iterable):
        raise InputError(f"{name}={brief(values)}: expected a path or a sequence, found {type(values).__name__}")
    listed = list(values)
    for place, value in enumerate(listed):
        if not isinstance(value, kind):
            raise InputError(f"{name}[{place}]={brief(value)}: expected {kind.__name__}, found {type(value).__name__}")
    return listed


def encode(
    scene: Scene | StrPath,
    options: CompressOptions | None = None,
    progress: Progress = SILENT,
    *,
    cameras: Sequence[Camera] | StrPath | None = None,
    images: StrPath | Sequence[NDArray[np.uint8]] | None = None,
    **words: "Unpack[CompressWords]",
) -> tuple[bytes, CompressResult]:
    """Compress a scene to the bytes of a `.fgs`: the same bytes that `compress` writes.

    The file passes through the temporary folder (`TMPDIR`), which needs room for it. The arguments are those of `compress`.

    Returns
    -------
    tuple of bytes and CompressResult
        The file, and the result of `compress`.
    """
    if words.get("dry_run") or (options is not None and options.dry_run):
        raise InputError("dry_run: encode hands back what would be written; leave it out, or call compress")
    with tempfile.TemporaryDirectory(prefix="flexgs-") as folder:
        place = Path(folder) / "scene.fgs"
        result = compress(scene, place, options, progress, cameras=cameras, images=images, **words)
        return place.read_bytes(), replace(result, output=MEMORY)


def decode(file: bytes | bytearray | memoryview | StrPath) -> Scene:
    """Open the scene of a `.fgs` file. Values are decoded when they are read.

    Parameters
    ----------
    file : bytes or path
        The file itself or its path. Bytes are kept as a temporary file as long as the scene lives.

    Raises
    ------
    FormatError
        If the file does not follow the format.
    """
    if isinstance(file, (str, os.PathLike)):
        return Scene(replace(checked_scene(open_fgs(file), Path(file)), file_bytes=os.stat(file).st_size))
    if not isinstance(file, (bytes, bytearray, memoryview)):
        raise InputError(f"file={brief(file)}: expected bytes or a path, found {type(file).__name__}")
    # A container opens its file for each read, so bytes need a file as long as the source lives.
    folder = tempfile.TemporaryDirectory(prefix="flexgs-")
    try:
        place = Path(folder.name) / "scene.fgs"
        place.write_bytes(file)
        source = open_fgs(place)
        weakref.finalize(source, folder.cleanup)
        source.name = MEMORY
        return Scene(checked_scene(source))
    except BaseException:
        folder.cleanup()
        raise
