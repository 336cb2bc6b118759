"""Scenes for tests of other programs' formats, and comparisons of what came back."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from flexgs_edge.api.scene import Scene
from flexgs_edge.errors import FormatError
from flexgs_edge.io.exchange import near_order, read_foreign, write_foreign
from flexgs_edge.io.reading import PLAIN, Writing
from flexgs_edge.run.inputs import checked_scene
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import MemorySource, Planes, SceneSource
from synthetic import look_from, make_camera


def scene(count: int = 300, degree: int = 3, seed: int = 0, spread: float = 3.0) -> MemorySource:
    """Values that every format can hold: opacities off 0 and 1, scales and colours inside the ranges of 8 bits."""
    rng = np.random.default_rng([seed, count, degree])
    planes = {
        "means": rng.uniform(-spread, spread, (3, count)),
        "sh_dc": rng.uniform(-1.5, 1.5, (3, count)),
        "sh_rest": rng.uniform(-0.6, 0.6, (3 * sh_rest_count(degree), count)),
        "opacity_logits": rng.uniform(-4, 4, (1, count)),
        "log_scales": rng.uniform(-6, 0, (3, count)),
        "quats": rng.normal(size=(4, count)) * rng.uniform(0.4, 1.8, count),
    }
    return MemorySource({name: plane.astype(np.float32) for name, plane in planes.items()}, degree)


def planes_of(source: SceneSource) -> Planes:
    """All values."""
    return source.read(slice(0, source.count), list(FIELD))


def there_and_back(path: Path, source: SceneSource, writing: Writing = PLAIN) -> tuple[Planes, Planes]:
    """All values before and after: `source` in the order in which it is written, and what is read from the file."""
    write_foreign(path, source, writing=writing)
    back = read_foreign(path)
    assert (back.count, back.sh_degree, back.name) == (source.count, source.sh_degree, str(path))
    order = near_order(source, path.name.endswith(".compressed.ply"))
    return planes_of(source.select(order)), planes_of(back)


def opacities(planes: Planes) -> np.ndarray:
    """[1, n] f64, 0 to 1."""
    opaque: np.ndarray = 1 / (1 + np.exp(-planes["opacity_logits"].astype(np.float64)))
    return opaque


def degrees_apart(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """[n] f64, angles between the rotations of quaternions [4, n] of any norm and sign."""
    a, b = a.astype(np.float64), b.astype(np.float64)
    a, b = a / np.linalg.norm(a, axis=0), b / np.linalg.norm(b, axis=0)
    near = np.minimum(np.linalg.norm(a - b, axis=0), np.linalg.norm(a + b, axis=0))
    angles: np.ndarray = np.degrees(4 * np.arcsin(near / 2))
    return angles


def largest_errors(ours: Planes, theirs: Planes) -> dict[str, float]:
    """By field, the largest difference: of opacities, of angles in degrees, else of values."""
    errors = {
        name: float(np.abs(ours[name].astype(np.float64) - theirs[name]).max(initial=0))
        for name in ("means", "sh_dc", "sh_rest", "log_scales")
    }
    errors["opacity_logits"] = float(np.abs(opacities(ours) - opacities(theirs)).max())
    errors["quats"] = float(degrees_apart(ours["quats"], theirs["quats"]).max())
    return errors


def refused(path: Path, data: bytes) -> str:
    """The message by which a file of these bytes is refused as it is opened."""
    path.write_bytes(data)
    try:
        read_foreign(path)
    except FormatError as error:
        assert str(path) in str(error) and len(str(error)) < 500
        return str(error)
    raise AssertionError(f"{len(data)} bytes were read")


def psnr_after(path: Path, source: SceneSource, writing: Writing = PLAIN) -> float:
    """dB between pictures of a scene before and after a file, from one side: wrong axes or signs change colours."""
    rotation, translation = look_from(5)
    camera = make_camera(64, 48, 60.0, rotation, translation)
    write_foreign(path, source, writing=writing)
    first, second = (Scene(checked_scene(each)).render(camera) for each in (source, read_foreign(path)))
    return float(-10 * np.log10(np.mean(np.square(first.astype(np.float64) - second))))
