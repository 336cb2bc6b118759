"""Files of extreme codes, and what a decoder must read from them: test vectors for every decoder of `.fgs`.

`python tests/helpers/web_vectors.py` writes those of web/decoder/tests/vectors anew.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.codec.open_fgs import open_fgs
from flexgs_edge.codec.v1.container import CHUNK_ROWS, write_container
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.constants import CODE_LIMIT
from flexgs_edge.grid.grid_scene import GridScene, row_places
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.scene.contraction import Contraction
from flexgs_edge.scene.curve import morton
from flexgs_edge.scene.fields import FIELD
from quantized_scenes import make_scene, quantize_all

FOLDER = Path(__file__).resolve().parents[2] / "web" / "decoder" / "tests" / "vectors"
SETTINGS = {"near": 0.2, "text": "\u00e9"}
STEPS = StepSizes(0.0021, 0.25, 0.05, 0.4, 0.1, (0.2, 0.25, 0.3, 0.35), 1.7)
FIELDS = ("means", "sh_dc", "sh_rest", "opacity_logits", "log_scales", "quats")

Draw = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]


def _near(size: int) -> Draw:
    return lambda rng, shape: rng.integers(-size, size + 1, shape)


SMALL, SMALLER = _near(5), _near(2)


def _tailed(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    """Mostly small, one in thirty anywhere: escapes."""
    far = rng.integers(-CODE_LIMIT, CODE_LIMIT + 1, shape)
    return np.where(rng.random(shape) < 1 / 30, far, rng.integers(-3, 4, shape))


def _ends(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return rng.choice([-CODE_LIMIT, CODE_LIMIT], shape)


def _one(rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    return np.full(shape, -7)


def random_grid(
    rows: int,
    degree: int,
    depth: int,
    codes: Draw = SMALL,
    sh: Draw = SMALLER,
    layers: int = 1,
    low: int = -40,
    cells: int = 0,
    seed: int = 0,
) -> GridScene:
    """Codes without any structure; `cells`: rows share so many cells."""
    rng = np.random.default_rng(seed)
    layer = np.sort(rng.integers(0, layers, rows))
    place = rng.integers(0, 1 << depth, (3, cells or rows))
    if place.shape[1] > 1:
        place[:, 0], place[:, -1] = 0, (1 << depth) - 1
    position = place[:, rng.integers(0, cells, rows)] if cells else place
    position = position[:, np.lexsort((morton(position.astype(np.int64)), layer))] + low
    degrees = rng.integers(0, degree + 1, rows).astype(np.uint8)
    if rows:
        degrees[0] = degree
    bands = [
        sh(rng, (6 * level + 3, int(np.count_nonzero(degrees >= level)))).astype(np.int32)
        for level in range(1, degree + 1)
    ]

    def draw(*shape: int) -> np.ndarray:
        return codes(rng, shape).astype(np.int32)

    return GridScene(
        rows,
        degree,
        np.array([1234.5, -0.1, 1e-7]),
        replace(STEPS, sh=STEPS.sh[:degree]),
        position.astype(np.int32),
        draw(3, rows),
        draw(3, rows),
        draw(rows),
        draw(3, rows),
        degrees,
        tuple(bands),
        layer.astype(np.uint8),
    )


def _contracted(grid: GridScene, radius: float) -> GridScene:
    contraction = Contraction((0.03, -0.2, 1e-3), radius)
    return replace(grid, step_sizes=replace(grid.step_sizes, contraction=contraction))


KINDS: dict[str, tuple[Callable[[], GridScene], int]] = {
    "no rows": (lambda: random_grid(0, 0, 0), 65536),
    "no rows, degree 3": (lambda: random_grid(0, 3, 0), 65536),
    "one row, degree 4": (lambda: random_grid(1, 4, 0), 65536),
    "255 rows": (lambda: random_grid(255, 1, 4), 65536),
    "256 rows": (lambda: random_grid(256, 1, 5), 65536),
    "257 rows": (lambda: random_grid(257, 1, 6), 65536),
    "depth 21": (lambda: random_grid(300, 0, 21, low=-(2**20)), 65536),
    "depth 0, 300 in one cell": (lambda: random_grid(300, 0, 0), 65536),
    "crowds in few cells": (lambda: random_grid(600, 0, 7, cells=5), 65536),
    "cells at the end of the range": (lambda: random_grid(40, 0, 3, low=CODE_LIMIT - 7), 65536),
    "escapes": (lambda: random_grid(400, 1, 8, _tailed, _tailed), 65536),
    "codes anywhere": (lambda: random_grid(260, 0, 8, _near(CODE_LIMIT)), 65536),
    "codes at both ends": (lambda: random_grid(260, 0, 8, _ends, _ends), 65536),
    "all codes equal": (lambda: random_grid(300, 2, 8, _one, _one), 65536),
    "200 layers, some of them empty": (lambda: random_grid(300, 0, 9, layers=200), 65536),
    "chunks of one row": (lambda: random_grid(20, 1, 6), 1),
    "degree 4, SH beyond the limit of a sum": (lambda: random_grid(290, 4, 8, sh=_near(40000)), 65536),
    "three chunks of 512 rows in two layers": (lambda: random_grid(1100, 2, 9, layers=2), 512),
    "contracted": (lambda: _contracted(random_grid(400, 1, 14, low=-(2**13)), 0.7), 65536),
    "contracted beyond all octaves": (lambda: _contracted(random_grid(300, 0, 21, low=-(2**20)), 1e-3), 65536),
}
"""The 20 kinds: the scene, and the most rows of a chunk."""

PREVIEWED = "a preview before chunks of 256 rows"
"""A further file; its preview is that of 255 rows."""

PACKED: dict[str, tuple[int, int, BitSpec, int | None]] = {
    "version 1, no SH": (9, 0, BitSpec(xyz=16, dc=1, scale=5, rot=11, opacity=3, rest=2), None),
    "version 1, degree 4, many groups": (23, 4, BitSpec(xyz=13, dc=8, scale=7, rot=9, opacity=16, rest=2), 7),
}
"""Files of version 1: rows, degree, bits and groups."""
PACKED_FAR = "version 1, contracted"
"""A further file: the last one with contracted positions."""


def write_all(folder: Path) -> dict[str, Path]:
    """Write each kind; returns the files by the name of their kind."""
    folder.mkdir(parents=True, exist_ok=True)
    files = {}
    for name, (make, chunk_rows) in KINDS.items():
        files[name] = folder / _file_name(name)
        write_grid(files[name], make(), SETTINGS, chunk_rows=chunk_rows, force=True)
    files[PREVIEWED] = folder / _file_name(PREVIEWED)
    small = files["255 rows"].read_bytes()
    write_grid(files[PREVIEWED], random_grid(600, 1, 7, layers=2), SETTINGS, chunk_rows=256, preview=small, force=True)
    for name, (rows, degree, bits, groups) in PACKED.items():
        files[name] = folder / _file_name(name)
        scene = quantize_all(make_scene(rows, degree), bits, groups)
        write_container(files[name], scene, SETTINGS, force=True)
        if degree:
            files[PACKED_FAR] = folder / _file_name(PACKED_FAR)
            write_container(
                files[PACKED_FAR], replace(scene, contraction=Contraction((0.5, -0.25, 0.1), 0.3)), SETTINGS, force=True
            )
    return files


def _file_name(name: str) -> str:
    return "".join(letter for letter in name.replace(" ", "_") if letter.isalnum() or letter == "_") + ".fgs"


def expected(path: Path) -> dict[str, Any]:
    """What a decoder must read: checksums of the codes (i32) and values (f32) of each chunk, in the order of docs/format.md."""
    source = open_fgs(path)
    record: dict[str, Any] = {"version": source.container.version, "count": source.count, "sh_degree": source.sh_degree}
    record["origin"] = source.origin.tolist()
    if isinstance(source, GridSource):
        header = source.container.header
        grid = source.grid()
        bounds = [(chunk.start, chunk.stop) for chunk in header.chunks()]
        record["layers"] = list(header.layers)
        record["codes"] = [_sum(_codes(grid, start, stop)) for start, stop in bounds]
    else:
        bounds = [(at, min(at + CHUNK_ROWS, source.count)) for at in range(0, source.count, CHUNK_ROWS)]
        record["layers"] = [source.count]
    record["values"] = []
    for start, stop in bounds:
        planes = source.read(slice(start, stop), list(FIELD))
        record["values"].append(_sum(planes[field] for field in FIELDS))
    return record


def _codes(grid: GridScene, start: int, stop: int) -> Iterable[np.ndarray]:
    rows = slice(start, stop)
    yield from (grid.position[:, rows], grid.scale[:, rows], grid.rotation[:, rows], grid.opacity[rows])
    yield from (grid.dc[:, rows], grid.sh_degrees[rows].astype(np.int32))
    for degree, band in enumerate(grid.sh, start=1):
        has = np.flatnonzero(grid.sh_degrees[rows] >= degree) + start
        yield band[:, row_places(grid.sh_degrees, has, degree)]


def _sum(parts: Iterable[np.ndarray]) -> str:
    checksum = 0
    for part in parts:
        checksum = zlib.crc32(np.ascontiguousarray(part).tobytes(), checksum)
    return f"{checksum:08x}"


def write_expected(files: Iterable[Path], path: Path) -> None:
    """Write what must be read from files into a JSON beside them."""
    lines = [f"{json.dumps(file.name)}: {json.dumps(expected(file))}" for file in files]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def main(folder: Path = FOLDER) -> None:
    write_expected(write_all(folder).values(), folder / "vectors.json")


__all__ = ["FOLDER", "KINDS", "PACKED", "expected", "random_grid", "write_all", "write_expected"]

if __name__ == "__main__":
    main()
