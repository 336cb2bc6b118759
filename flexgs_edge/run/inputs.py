"""From a path to a checked scene, and to options with every drawing setting filled in."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from flexgs_edge.cameras.nerfstudio import dataparser_above
from flexgs_edge.cameras.read import NERF_SYNTHETIC, find_cameras
from flexgs_edge.cameras.start import StartView
from flexgs_edge.constants import DEFAULT_NEAR
from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.frames import RDF, Frame
from flexgs_edge.io.model_folder import Companions, find_companions
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.io.reading import AS_WRITTEN, Reading, crop_of
from flexgs_edge.progress import LOG
from flexgs_edge.report.run_info import SceneInfo
from flexgs_edge.run.open_scene import open_file
from flexgs_edge.run.options import ViewOptions
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.crop import Crop, cropped
from flexgs_edge.scene.source import GrownSource, SceneSource, without_degrees


def companions_of(path: str | os.PathLike[str]) -> Companions:
    """Find cameras, photos and drawing settings beside the scene at `path`, and log the cameras and photos found."""
    found = find_companions(path)
    if found.cameras is None:
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        found = replace(found, cameras=find_cameras(folder))
        if found.images is None and found.cameras == folder / NERF_SYNTHETIC and (folder / "train").is_dir():
            found = replace(found, images=folder / "train")
    found = replace(found, dataparser=dataparser_above(Path(path)))
    for what, place in (("cameras", found.cameras), ("photos", found.images)):
        if place is not None:
            LOG.info("found %s beside the scene: %s", what, place)
    return found


def merge_companions(first: Companions, second: Companions) -> Companions:
    """Combine the companions of two scenes.

    Cameras and photos both come from `first` if it has cameras, else from `second`: photos of another place would not match.
    Background and antialiasing come from whichever scene states them, `first` before `second`.
    """
    chosen = first if first.cameras is not None else second
    white = first.white_background if first.white_background is not None else second.white_background
    antialiased = first.antialiased if first.antialiased is not None else second.antialiased
    return Companions(chosen.cameras, chosen.images, white, antialiased, chosen.dataparser)


Options = TypeVar("Options", bound=ViewOptions)


@dataclass(frozen=True)
class CheckedScene:
    """A scene whose values have been checked, and the settings that its file states.

    `input_count`, `input_sh_degree`: Gaussians and SH degree of the file, before anything was left out.
    """

    path: Path | None  # as given; `None` for a scene from memory, which has no cameras or photos beside it
    source: SceneSource  # every value is finite; there is at least one Gaussian
    input_count: int
    input_sh_degree: int
    # How a `.fgs` was made. Other files only state drawing settings, if any (`antialiased` in a `.spz`).
    settings: dict[str, Any]
    held_bytes: int = 0  # bytes of the file's packed values in memory
    # Bytes of the input file, or of all files that were read; `None` for a scene from memory.
    file_bytes: int | None = None
    frame: Frame = RDF  # directions of the axes in the file
    whole: int | None = None  # Gaussians of the scene that a cut file is a part of
    crop: Crop | None = None  # what the scene was cropped to, now or before it was compressed

    @property
    def drawn(self) -> SceneSource:
        """The scene as pictures show it: what is left of a file that was cut is drawn larger."""
        return self.source if self.whole is None else GrownSource(self.source, self.whole)

    @property
    def start(self) -> StartView | None:
        """The view to start from, which a `.fgs` may have."""
        return StartView.stored(self.settings)

    @property
    def ply_bytes(self) -> int:
        """Bytes of the scene as a PLY in INRIA's layout, with normals: 248 per Gaussian at SH degree 3."""
        return self.input_count * inria_dtype(self.input_sh_degree).itemsize

    @property
    def ply_bytes_without_normals(self) -> int:
        """Bytes of the scene as a PLY without normals, which no viewer reads."""
        return self.ply_bytes - 12 * self.input_count


ScenePlace = str | os.PathLike[str] | CheckedScene  # A scene file, a model folder, or a scene that is already open


def read_scene(path: str | os.PathLike[str], drop_invalid: bool = False) -> SceneSource:
    """Open a scene file or a model folder, and check that its values are finite. Later reads are lazy."""
    return load_scene(path, drop_invalid).source


def load_scene(path: ScenePlace, drop_invalid: bool = False, reading: Reading = AS_WRITTEN) -> CheckedScene:
    """Open a scene and check every value once. Raises `InputError` for invalid values, unless `drop_invalid` leaves them out.

    A scene that is already open only loses what `reading` leaves out.
    """
    if isinstance(path, CheckedScene):
        if reading.frame is not None or reading.lod is not None:
            raise InputError("frame and lod say how a file is read, and this scene is open: give them to Scene.open")
        return _reduced(path, reading)
    opened = open_file(path, reading)
    checked = checked_scene(opened.source, Path(path), drop_invalid)
    return _reduced(replace(checked, file_bytes=opened.bytes, frame=opened.frame), reading)


def _reduced(scene: CheckedScene, reading: Reading) -> CheckedScene:
    """Without SH above a degree, and without what lies beyond a crop: sizes are then compared with what is left."""
    source = without_degrees(scene.source, reading.sh_degree)
    if reading.crop is None:
        return replace(scene, source=source)
    source = cropped(source, reading.crop)
    return replace(scene, source=source, input_count=source.count, file_bytes=None, crop=reading.crop)


def checked_scene(opened: SceneSource, path: Path | None = None, drop_invalid: bool = False) -> CheckedScene:
    """Check every value of an open scene once."""
    return CheckedScene(
        path,
        check_scene(opened, drop_invalid),
        opened.count,
        opened.sh_degree,
        dict(opened.settings),
        opened.held_bytes,
        whole=opened.whole,
        crop=_stored_crop(opened),
    )


def _stored_crop(opened: SceneSource) -> Crop | None:
    """What a `.fgs` was cropped to before it was compressed."""
    try:
        return crop_of(opened.settings["crop"], opened.name) if "crop" in opened.settings else None
    except InputError as error:
        raise FormatError(f"{opened.name}: settings in the header: {error}") from error


def resolve_drawing(options: Options, scene: CheckedScene, companions: Companions) -> Options:
    """Fill in every drawing setting: from the options, else from the files, else from the defaults."""
    stored = scene.settings
    background = options.background
    if background is None:
        white = (1.0, 1.0, 1.0) if companions.white_background else (0.0, 0.0, 0.0)
        background = _background(stored.get("background"), white)
    near = options.near
    if near is None:
        found = stored.get("near")
        near = float(found) if isinstance(found, (int, float)) and found > 0 else DEFAULT_NEAR
    antialiased = options.antialiased
    if antialiased is None:
        found = stored.get("antialiased", companions.antialiased)
        antialiased = found if isinstance(found, bool) else False
        if antialiased:
            LOG.info("drawing antialiased, as %s says", "the file" if "antialiased" in stored else "cfg_args")
    return replace(options, near=near, background=background, antialiased=antialiased)


def _background(value: object, default: tuple[float, float, float]) -> tuple[float, float, float]:
    if isinstance(value, list) and len(value) == 3 and all(isinstance(v, (int, float)) and 0 <= v <= 1 for v in value):
        return (float(value[0]), float(value[1]), float(value[2]))
    return default


def scene_info(scene: CheckedScene) -> SceneInfo:
    """The scene as a record for results."""
    return SceneInfo(
        path=scene.source.name if scene.path is None else os.fspath(scene.path),
        count=scene.source.count,
        sh_degree=scene.source.sh_degree,
        ply_bytes=scene.ply_bytes,
        ply_bytes_without_normals=scene.ply_bytes_without_normals,
        notes=tuple(scene.source.notes),
        bytes=scene.file_bytes,
    )
