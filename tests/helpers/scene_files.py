"""Scene files for tests, written without the package's own writer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from flexgs_edge.io.reading import AS_WRITTEN, Reading
from flexgs_edge.run.open_scene import open_file
from flexgs_edge.scene.source import SceneSource

REST = {0: 0, 1: 9, 2: 24, 3: 45, 4: 72}
TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "i4": "int"}


def property_names(degree: int, normals: bool = True) -> list[str]:
    """INRIA's properties in INRIA's order."""
    rest = [f"f_rest_{i}" for i in range(REST[degree])]
    others = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    return ["x", "y", "z", *(["nx", "ny", "nz"] if normals else []), "f_dc_0", "f_dc_1", "f_dc_2", *rest, *others]


def random_rows(
    count: int, degree: int = 0, seed: int = 0, order: str = "<", names: Sequence[str] | None = None, double: str = ""
) -> np.ndarray:
    """Structured rows of random numbers; properties that start with a letter of `double` are float64."""
    names = property_names(degree) if names is None else names
    rng = np.random.default_rng(seed)
    dtype = np.dtype([(n, order + ("f8" if double and n[0] in double else "f4")) for n in names])
    rows = np.zeros(count, dtype)
    for name in names:
        rows[name] = rng.normal(size=count)
    return rows


def header(rows: np.ndarray, kind: str | None = None, extra: str = "", comment: str = "") -> bytes:
    """A header for `rows`; `extra` goes behind the vertex properties."""
    dtype = rows.dtype
    if kind is None:
        kind = "binary_big_endian" if dtype[0].str.startswith(">") else "binary_little_endian"
    lines = ["ply", f"format {kind} 1.0", *([f"comment {comment}"] if comment else []), f"element vertex {len(rows)}"]
    lines += [f"property {TYPES[dtype[name].str[1:]]} {name}" for name in dtype.names or ()]
    return ("\n".join([*lines, *([extra] if extra else []), "end_header"]) + "\n").encode()


def write_rows(path: Path, rows: np.ndarray, tail: bytes = b"", **kwargs: str) -> Path:
    """A binary PLY of `rows`."""
    path.write_bytes(header(rows, **kwargs) + rows.tobytes() + tail)
    return path


def planes_of(rows: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """[width, n] f32 of some properties."""
    return np.array([rows[name] for name in names], np.float32).reshape(len(names), len(rows))


def edit(data: bytes, old: str, new: str) -> bytes:
    """`data` with one piece of text replaced; it must be there."""
    assert old.encode() in data
    return data.replace(old.encode(), new.encode(), 1)


def open_scene(path: str | Path, reading: Reading = AS_WRITTEN) -> SceneSource:
    """The values of a scene file, with its axes in RDF."""
    return open_file(path, reading).source
