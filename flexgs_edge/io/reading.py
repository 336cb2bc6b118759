"""What a user may say about how a scene file is read, and which part of it (`--crop`)."""

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.constants import MAX_SH_DEGREE
from flexgs_edge.errors import InputError, brief
from flexgs_edge.io.frames import Frame
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.scene.crop import Crop
from flexgs_edge.scene.rotations import matrices

EXPECTED = "expected six numbers (two corners), four (a sphere: centre, radius), or a JSON file with a box (docs/formats.md#crop)"
LARGEST_FILE = 1 << 20


@dataclass(frozen=True)
class Reading:
    """How to read a scene file."""

    # The frame of the file's axes, if it breaks the rule of its format. Default: as the file says, else as its format has it.
    frame: Frame | None = None
    lod: int | None = None  # Level of detail of a streamed scene, 0 is the finest. Default: the finest that is there.
    sh_degree: int | None = None  # Leave out SH above this degree. Default: keep all.
    crop: Crop | None = None  # Leave out Gaussians beyond it. Default: keep all.
    budget: MemoryBudget | None = None  # What a file unpacks to must fit into it. Default: it is not checked.
    held: int = 0  # Bytes of other files that are read with this one

    @classmethod
    def of(
        cls, frame: str | None, lod: int | None = None, sh_degree: int | None = None, crop: str | None = None
    ) -> "Reading":
        """From the words of options."""
        box = None if crop is None else parse_crop(crop)
        return cls(None if frame is None else Frame(frame.strip().upper()), lod, sh_degree, box)

    def require(self, name: str, size: int) -> None:
        """Raise `BudgetError` unless `size` bytes fit that reading the file `name` takes."""
        if self.budget is not None:
            self.budget.require(f"reading {name}", self.held + size)

    def beside(self, held: int) -> "Reading":
        """For one more file where others hold so many bytes."""
        return replace(self, held=held)

    def __post_init__(self) -> None:
        if self.sh_degree is not None and not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"--sh-degree {self.sh_degree}: expected 0 to {MAX_SH_DEGREE}")
        if self.lod is not None and self.lod < 0:
            raise InputError(f"--lod {self.lod}: expected 0 (the finest level) or more")


GLB_KINDS = ("plain", "spz")


@dataclass(frozen=True)
class Writing:
    """How to write a scene for other programs."""

    spz_version: int = 3  # Version of a `.spz`. Older programs read only 3.
    antialiased: bool = False  # the model is antialiased; formats that can say so, do
    force_lossy: bool = False  # Write a scene also where the format cannot hold its positions: see `check_positions`
    glb: str = "plain"  # What holds the values of a `.glb`: `plain` numbers or a `spz`.
    double: bool = False  # Positions of a `.ply` are float64. Default: as they came, see `exchange.wants_double`.

    def __post_init__(self) -> None:
        if self.spz_version not in (3, 4):
            raise InputError(f"--spz-version {self.spz_version}: expected 3 or 4")
        if self.glb not in GLB_KINDS:
            raise InputError(f"--glb {self.glb}: expected {' or '.join(GLB_KINDS)}")


AS_WRITTEN = Reading()
PLAIN = Writing()


def parse_crop(text: str) -> Crop:
    """The crop that a user names: numbers, or the path of a JSON file. Raises `InputError`."""
    words = text.replace(",", " ").split()
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        return crop_of(_read(Path(text)), text)
    if len(numbers) == 6:
        low, high = numbers[:3], numbers[3:]
        return _box([(a + b) / 2 for a, b in zip(low, high)], [b - a for a, b in zip(low, high)], np.eye(3), text)
    if len(numbers) == 4:
        return _sphere(numbers[:3], numbers[3], text)
    raise InputError(f"--crop {text}: {EXPECTED}")


def crop_of(value: Any, name: str) -> Crop:
    """The crop of a JSON object; `name` is what messages call it.

    A sphere has `center` and `radius`; a box has `min` and `max`, or `center` and `size`, and then perhaps `rotation` (a
    quaternion w x y z) or `axes` (three directions). nerfstudio's boxes are read too: `crop_center`, `crop_scale` and
    `crop_rot`, or `obb_...`, also within `crop`. `frame` names the directions of the axes, such as RUB (default: RDF).
    """
    if isinstance(value, dict) and isinstance(value.get("crop"), dict):
        value = value["crop"]
    if not isinstance(value, dict):
        raise InputError(f"--crop {name}: expected a JSON object, found {brief(value)}")
    fields = {key.removeprefix("crop_").removeprefix("obb_"): values for key, values in value.items()}
    if "min" in fields and "max" in fields:
        low, high = _numbers(fields, "min", 3, name), _numbers(fields, "max", 3, name)
        found = _box((low + high) / 2, high - low, np.eye(3), name)
    elif "radius" in fields:
        found = _sphere(_numbers(fields, "center", 3, name), float(_numbers(fields, "radius", 1, name)[0]), name)
    else:
        size = _numbers(fields, "size" if "size" in fields else "scale", 3, name)
        found = _box(_numbers(fields, "center", 3, name), size, _axes(fields, name), name)
    if "frame" in fields:
        found = found.turned(tuple(int(sign) for sign in Frame(str(fields["frame"]).upper()).signs))
    return found


def _read(path: Path) -> Any:
    try:
        with open(path, encoding="utf-8") as file:
            return json.loads(file.read(LARGEST_FILE))
    except OSError as error:
        raise InputError(f"--crop {path}: {EXPECTED}; there is no such file ({error.strerror})") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"--crop {path}: not JSON ({error})") from error


def _numbers(fields: dict[str, Any], key: str, count: int, name: str) -> np.ndarray:
    value = fields.get(key)
    values = value if isinstance(value, list) else [value]
    # Comparisons, as a whole number may be too large for a float. NaN fails them too.
    good = (isinstance(v, (int, float)) and not isinstance(v, bool) and -1e300 < v < 1e300 for v in values)
    if len(values) != count or not all(good):
        raise InputError(f"--crop {name}: {key}: expected {count} finite numbers, found {brief(value)}")
    return np.array(values, np.float64)


def _axes(fields: dict[str, Any], name: str) -> np.ndarray:
    """[3, 3] f64, directions of the edges."""
    if "axes" in fields:
        rows = fields["axes"]
        if not isinstance(rows, list) or len(rows) != 3:
            raise InputError(f"--crop {name}: axes: expected three directions, found {brief(rows)}")
        axes = np.stack([_numbers({"axes": row}, "axes", 3, name) for row in rows])
        if not np.allclose(axes @ axes.T, np.eye(3), atol=1e-3):
            raise InputError(f"--crop {name}: axes: expected three directions of length 1 at right angles")
        return axes
    if "rot" in fields or ("rotation" in fields and "scale" in fields):  # nerfstudio: turns about x, y, z, in radians
        x, y, z = _numbers(fields, "rot" if "rot" in fields else "rotation", 3, name)
        (a, b), (c, d), (e, f) = ((math.cos(turn), math.sin(turn)) for turn in (x, y, z))
        about_x = np.array([[1, 0, 0], [0, a, -b], [0, b, a]])
        about_y = np.array([[c, 0, d], [0, 1, 0], [-d, 0, c]])
        about_z = np.array([[e, -f, 0], [f, e, 0], [0, 0, 1]])
        return np.asarray((about_z @ about_y @ about_x).T)
    if "rotation" in fields:
        quat = _numbers(fields, "rotation", 4, name)
        if not quat.any():
            raise InputError(f"--crop {name}: rotation: expected a quaternion w x y z, found zeros")
        return np.asarray(matrices(quat[:, None] / np.linalg.norm(quat))[0].T)
    return np.eye(3)


def _box(centre: Any, size: Any, axes: np.ndarray, name: str) -> Crop:
    edges = [float(edge) for edge in size]
    places = [float(value) for value in centre]
    if not all(map(math.isfinite, (*edges, *places))) or min(edges) <= 0:
        raise InputError(
            f"--crop {name}: a box of {' x '.join(f'{edge:.6g}' for edge in edges)}: expected edges above 0 (the lowest corner "
            "first, then the highest)"
        )
    return Crop(tuple(places), tuple(edge / 2 for edge in edges), tuple(tuple(map(float, axis)) for axis in axes))


def _sphere(centre: Any, radius: float, name: str) -> Crop:
    places = [float(value) for value in centre]
    if not all(map(math.isfinite, (radius, *places))) or radius <= 0:
        raise InputError(f"--crop {name}: a sphere of radius {radius:.6g}: expected a radius above 0")
    return Crop(tuple(places), (float(radius),) * 3, sphere=True)
