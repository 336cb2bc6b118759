"""Find the scene in INRIA's model folders, and the cameras and photos beside a scene."""

import ast
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flexgs_edge.errors import FormatError, InputError

_ITERATION = re.compile(r"iteration_([0-9]{1,18})")
_CFG_LIMIT = 1 << 16  # Most bytes of cfg_args, which normally has a few hundred
POINT_CLOUD = "point_cloud.ply"  # What INRIA's program calls the scene of an iteration


def latest_iteration(folder: Path) -> Path:
    """The `point_cloud.ply` of the highest iteration in a model folder, or the one that lies in the folder itself."""
    found = {
        int(match.group(1)): ply
        for ply in folder.glob(f"point_cloud/iteration_*/{POINT_CLOUD}")
        if (match := _ITERATION.fullmatch(ply.parent.name)) and ply.is_file()
    }
    if found:
        return found[max(found)]
    if (folder / POINT_CLOUD).is_file():
        return folder / POINT_CLOUD
    raise InputError(
        f"{folder}: no {POINT_CLOUD} and no point_cloud/iteration_*/{POINT_CLOUD} in this folder; is it a model folder?"
    )


@dataclass(frozen=True)
class Companions:
    """Cameras, photos and settings that were found beside a scene; None for those that were not."""

    cameras: Path | None = None
    images: Path | None = None
    white_background: bool | None = None
    antialiased: bool | None = None
    dataparser: Path | None = None


def find_companions(path: str | os.PathLike[str]) -> Companions:
    """Find the cameras, photos and drawing settings that belong to a scene.

    The search covers the folder of the file (`cameras.json`, `images/`), or the model folder: the given one, or the one that
    holds the file as `point_cloud/iteration_*/*.ply`. `cfg_args` of a model folder names the background, and photos in another
    place. It may also tell that the model is antialiased; the reference program leaves `antialiasing` out.

    Raises `FormatError` if `cfg_args` cannot be understood.
    """
    place = Path(path)
    folder = place if place.is_dir() else place.parent
    holder = folder.absolute()  # a bare file name has no parents
    inside = _ITERATION.fullmatch(holder.name) and holder.parent.name == "point_cloud"
    if inside and not (folder / "cameras.json").is_file():
        folder = holder.parent.parent
    settings = _read_cfg_args(folder / "cfg_args")
    white, antialiased = settings.get("white_background"), settings.get("antialiasing")
    cameras = folder / "cameras.json"
    return Companions(
        cameras if cameras.is_file() else None,
        _find_images(folder, settings),
        white if isinstance(white, bool) else None,
        antialiased if isinstance(antialiased, bool) else None,
    )


def _find_images(folder: Path, settings: dict[str, Any]) -> Path | None:
    """The folder of photos: the one that cfg_args names if it exists, else `images/` beside the scene."""
    images, source = settings.get("images", "images"), settings.get("source_path")
    places = [folder / "images"]
    if isinstance(images, str) and isinstance(source, str) and images and source and "\0" not in images + source:
        places.insert(0, folder / source / images)  # an absolute source_path replaces `folder`
    return next((place for place in places if place.is_dir()), None)


def _read_cfg_args(path: Path) -> dict[str, Any]:
    """The arguments of the text `Namespace(key=value, ...)`, as literals; nothing is evaluated.

    The result is empty if there is no such file.
    """
    if not path.is_file():
        return {}
    try:
        with open(path, "rb") as file:
            text = file.read(_CFG_LIMIT + 1)
        call = ast.parse(text.decode().strip(), mode="eval").body
    except OSError as error:
        raise InputError(f"{path}: cannot read it ({error.strerror})") from error
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        raise FormatError(f"{path}: expected the text Namespace(key=value, ...), found {text[:40]!r}") from error
    if not isinstance(call, ast.Call) or not isinstance(call.func, ast.Name) or call.func.id != "Namespace":
        raise FormatError(f"{path}: expected the text Namespace(key=value, ...), found {text[:40]!r}")
    pairs = ((keyword.arg, keyword.value) for keyword in call.keywords)
    return {key: value.value for key, value in pairs if key is not None and isinstance(value, ast.Constant)}
