"""SOG scenes for tests, written without the package's own writer."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

RGBA = np.ndarray
COEFFICIENTS = {0: 0, 1: 3, 2: 8, 3: 15}


def coded(pixels: RGBA, kind: str = "WEBP") -> bytes:
    """A lossless picture."""
    place = io.BytesIO()
    options = {"lossless": True, "exact": True} if kind == "WEBP" else {}
    Image.fromarray(pixels).save(place, kind, **options)
    return place.getvalue()


def square(codes: np.ndarray, width: int) -> RGBA:
    """A picture of rows ([n, 4] u8), with pixels of other values behind the last one."""
    height = -(-len(codes) // width)
    pixels = np.full((height * width, 4), 7, np.uint8)
    pixels[: len(codes)] = codes
    return pixels.reshape(height, width, 4)


def random_pictures(count: int, degree: int, seed: int = 0, entries: int = 5, width: int = 4) -> dict[str, RGBA]:
    """Pictures of any bytes that mean something."""
    rng = np.random.default_rng(seed)
    names = ["means_l", "means_u", "scales", "quats", "sh0"] + (["shN_labels"] if degree else [])
    rows = {name: rng.integers(0, 256, (count, 4), np.uint8) for name in names}
    # Small offsets from three corners, so that the fourth component exists.
    rows["quats"][:, :3] = rng.integers(80, 176, (count, 3))
    rows["quats"][:, 3] = 252 + np.arange(count) % 4
    if degree:
        labels = rng.integers(0, entries, count)
        rows["shN_labels"][:, 0], rows["shN_labels"][:, 1] = labels & 255, labels >> 8
    pictures = {name: square(codes, width) for name, codes in rows.items()}
    if degree:
        height = -(-entries // 64)
        pictures["shN_centroids"] = rng.integers(0, 256, (height, 64 * COEFFICIENTS[degree], 4), np.uint8)
    return pictures


def meta_of(version: int, count: int, degree: int, entries: int = 5, kind: str = "webp") -> dict[str, Any]:
    """A valid `meta.json` of either version."""
    book = [round(-3 + i / 64, 6) for i in range(256)]
    files = {
        name: {"files": [f"{part}.{kind}" for part in parts]}
        for name, parts in {
            "means": ["means_l", "means_u"], "scales": ["scales"], "quats": ["quats"], "sh0": ["sh0"],
            "shN": ["shN_centroids", "shN_labels"],
        }.items()
    }  # fmt: skip
    files["means"] |= {"mins": [-1.5, -0.5, 0.25], "maxs": [2.0, 0.5, 1.25]}
    if version == 2:
        files["scales"]["codebook"] = [value - 2 for value in book]
        files["sh0"]["codebook"] = book
        files["shN"] |= {"count": entries, "bands": degree, "codebook": [value / 4 for value in book]}
        head = {"version": 2, "count": count}
    else:
        files["means"]["shape"] = [count, 3]
        files["scales"] |= {"mins": [-8.0, -7.0, -6.0], "maxs": [-1.0, -2.0, -3.0]}
        files["sh0"] |= {"mins": [-1.0, -2.0, -1.0, -4.0], "maxs": [1.0, 2.0, 3.0, 5.0]}
        files["shN"] |= {"mins": -0.5, "maxs": 0.75}
        head = {}
    if not degree:
        del files["shN"]
    return head | files


def zipped(meta: object, pictures: Mapping[str, bytes], folder: str = "") -> bytes:
    """A `.sog`."""
    place = io.BytesIO()
    with zipfile.ZipFile(place, "w") as archive:
        for name, data in {**pictures, "meta.json": json.dumps(meta).encode()}.items():
            archive.writestr(zipfile.ZipInfo(folder + name), data)
    return place.getvalue()


def sog_bytes(version: int, count: int = 9, degree: int = 1, kind: str = "webp", seed: int = 0) -> bytes:
    """A small `.sog` with random values."""
    pictures = random_pictures(count, degree, seed)
    data = {f"{name}.{kind}": coded(pixels, kind.upper()) for name, pixels in pictures.items()}
    return zipped(meta_of(version, count, degree, kind=kind), data)


def write_folder(folder: Path, version: int, count: int, degree: int, seed: int = 0) -> Path:
    """The pieces of a `.sog` as files; returns the place of its `meta.json`."""
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(io.BytesIO(sog_bytes(version, count, degree, seed=seed))) as archive:
        archive.extractall(folder)
    return folder / "meta.json"


def write_streamed(folder: Path) -> Path:
    """A streamed scene of three levels: level 0 is not there, level 1 has two files, level 2 one."""
    write_folder(folder / "1_0", 2, 12, 1, seed=1)
    write_folder(folder / "1_1", 2, 7, 2, seed=2)
    write_folder(folder / "2_0", 2, 5, 0, seed=3)
    write_folder(folder / "env", 2, 3, 0, seed=4)
    leaf = {"bound": {"min": [0, 0, 0], "max": [1, 1, 1]}}
    tree = {
        "bound": leaf["bound"],
        "children": [
            leaf | {"lods": {"0": entry(0, 0, 9), "1": entry(1, 8, 4), "2": entry(3, 0, 2)}},
            {"children": [leaf | {"lods": {"1": entry(2, 0, 7)}}, leaf | {"lods": {"1": entry(1, 0, 6), "2": entry(3, 2, 3)}}]},
        ],
    }  # fmt: skip
    names = ["0_0/meta.json", "1_0/meta.json", "1_1/meta.json", "2_0/meta.json"]
    meta = {"version": 1, "lodLevels": 3, "environment": "env/meta.json", "filenames": names, "tree": tree}
    (folder / "lod-meta.json").write_text(json.dumps(meta))
    return folder / "lod-meta.json"


def entry(file: int, offset: int, count: int) -> dict[str, int]:
    return {"file": file, "offset": offset, "count": count}
