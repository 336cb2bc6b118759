"""Headers of a hundred thousand entries: each reader refuses them at once, or takes time that grows as the file does."""

from __future__ import annotations

import gzip
import io
import json
import struct
import time
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from camera_files import colmap_records, images_binary, images_text, lenses_binary, lenses_text
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.sections import canonical_json, preamble
from flexgs_edge.errors import InputError
from flexgs_edge.run.open_scene import open_file
from gltf_files import EXTENSION, GltfBuilder, splat_arrays
from scene_files import header, random_rows
from sog_files import meta_of, sog_bytes, write_folder, write_streamed
from synthetic import make_camera

MANY = 100_000
SECONDS = 10.0
"""Processor seconds of each; about 1 on an idle machine without coverage. Looking through all entries for each takes minutes."""
VIEWS = 5_000
"""Whole cameras are many checks each."""
ROWS = random_rows(5)


def ply(entry: str, name: str = "a.ply", kind: str | None = None) -> Callable[[Path], Path]:
    """A scene whose header has many lines more; `{}` is their number."""

    def write(folder: Path) -> Path:
        (folder / name).write_bytes(
            header(ROWS, kind, "\n".join(entry.format(i) for i in range(MANY))) + ROWS.tobytes()
        )
        return folder / name

    return write


def gltf(change: Callable[[GltfBuilder], None]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        builder = GltfBuilder()
        builder.splats(splat_arrays())
        change(builder)
        return builder.glb(folder / "a.glb")

    return write


def nodes_beside(builder: GltfBuilder) -> None:
    for _ in range(MANY):
        builder.node(mesh=0)


def nodes_within(builder: GltfBuilder) -> None:
    builder.record["nodes"][0]["children"] = [1]
    builder.record["nodes"] += [{"children": [i + 2]} for i in range(MANY)] + [{}]


def primitives(builder: GltfBuilder) -> None:
    builder.record["meshes"][0]["primitives"] *= MANY


def shown_often(builder: GltfBuilder) -> None:
    """A thousand primitives, each shown by a thousand nodes: a million parts in a small file."""
    builder.record["meshes"][0]["primitives"] *= 1000
    for _ in range(1000):
        builder.node(mesh=0)


def attributes(builder: GltfBuilder) -> None:
    builder.record["meshes"][0]["primitives"][0]["attributes"] |= {
        f"{EXTENSION}:SH_DEGREE_{i}_COEF_0": 0 for i in range(1, MANY)
    }


def extensions(builder: GltfBuilder) -> None:
    builder.record["extensionsRequired"] = [f"EXT_{i}" for i in range(MANY)]


def extensions_within(builder: GltfBuilder) -> None:
    builder.record["meshes"][0]["primitives"][0]["extensions"][EXTENSION]["extensions"] = {
        f"EXT_{i}": {} for i in range(MANY)
    }


def views(builder: GltfBuilder) -> None:
    builder.record["bufferViews"] += [builder.record["bufferViews"][0]] * MANY
    builder.record["accessors"] += [builder.record["accessors"][0]] * MANY


def sog_entries(folder: Path) -> Path:
    place = io.BytesIO(sog_bytes(2))
    with zipfile.ZipFile(place, "a") as archive:
        for i in range(MANY):
            archive.writestr(zipfile.ZipInfo(f"p{i}"), b"")
    (folder / "a.sog").write_bytes(place.getvalue())
    return folder / "a.sog"


def sog_meta(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        place = write_folder(folder, 2, 9, 1)
        meta = meta_of(2, 9, 1)
        change(meta)
        place.write_text(json.dumps(meta))
        return place

    return write


def streamed(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        place = write_streamed(folder)
        meta = json.loads(place.read_text())
        change(meta)
        place.write_text(json.dumps(meta))
        return place

    return write


def leaves(meta: dict[str, Any]) -> None:
    meta["tree"] = {"children": [{"lods": {"1": {"file": 1, "offset": i, "count": 1}}} for i in range(MANY)]}


def files_of_leaves(meta: dict[str, Any]) -> None:
    meta["filenames"] = [f"x{i}/meta.json" for i in range(MANY)]
    meta["tree"] = {"children": [{"lods": {"1": {"file": i, "offset": 0, "count": 1}}} for i in range(MANY)]}


def spz_extensions(folder: Path) -> Path:
    packed = b"".join(struct.pack("<II", i + 1, 0) for i in range(MANY))
    data = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 2, 0) + bytes(20) + packed
    (folder / "a.spz").write_bytes(gzip.compress(data))
    return folder / "a.spz"


def gzip_members(folder: Path) -> Path:
    (folder / "a.ply.gz").write_bytes(gzip.compress(header(ROWS) + ROWS.tobytes()) + gzip.compress(b"") * MANY)
    return folder / "a.ply.gz"


def gzip_name(folder: Path) -> Path:
    (folder / "a.ply.gz").write_bytes(b"\x1f\x8b\x08\x08" + bytes(6) + b"n" * (20 * MANY))
    return folder / "a.ply.gz"


def ksplat_sections(folder: Path) -> Path:
    head = struct.pack("<BBxxIIIIHxxffff", 0, 1, MANY, MANY, 0, 0, 0, 0, 0, 0, 0)
    with open(folder / "a.ksplat", "wb") as file:
        file.write(head)
        file.truncate(4096 + 1024 * MANY)
    return folder / "a.ksplat"


def fgs(version: int, block: bytes) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        data = preamble(version, 36 + len(block), block) + block
        (folder / "a.fgs").write_bytes(data)
        return folder / "a.fgs"

    return write


KEYS = canonical_json({f"k{i:05}": i for i in range(MANY // 2)}).ljust(768 << 10)
TWICE = KEYS.replace(b'"k00000"', b'"k49999"')


def cameras(count: int) -> list[Any]:
    return [make_camera(12, 8, name=f"c{i}") for i in range(count)]


def inria(folder: Path) -> Path:
    entry = {"width": 12, "height": 8, "position": [0, 0, 0], "rotation": np.eye(3).tolist(), "fx": 9, "fy": 9}
    (folder / "a.json").write_text(json.dumps([entry | {"img_name": f"c{i}"} for i in range(VIEWS)]))
    return folder / "a.json"


def transforms(folder: Path) -> Path:
    matrix = np.eye(4).tolist()
    frames = [{"file_path": f"c{i}", "transform_matrix": matrix} for i in range(VIEWS)]
    (folder / "a.json").write_text(json.dumps({"w": 12, "h": 8, "fl_x": 9, "frames": frames}))
    return folder / "a.json"


def transforms_deep(folder: Path) -> Path:
    frames = [{"file_path": "a/" * MANY + f"c{i}", "transform_matrix": np.eye(4).tolist()} for i in range(3)]
    (folder / "a.json").write_text(json.dumps({"w": 12, "h": 8, "fl_x": 9, "frames": frames}))
    return folder / "a.json"


def keys(folder: Path) -> Path:
    (folder / "a.json").write_text(json.dumps([{f"k{i}": i for i in range(MANY)}]))
    return folder / "a.json"


def colmap(kind: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        lenses, images = colmap_records(cameras(1))
        number, model, *rest = lenses[0]
        many_lenses = [(i + 1, model, *rest) for i in range(VIEWS)]
        many_images = [(i + 1, *images[0][1:3], i + 1, f"c{i}") for i in range(VIEWS)]
        if kind == "bin":
            (folder / "cameras.bin").write_bytes(lenses_binary(many_lenses))
            (folder / "images.bin").write_bytes(images_binary(many_images, 0))
        else:
            (folder / "cameras.txt").write_text(lenses_text(many_lenses))
            (folder / "images.txt").write_text(images_text(many_images))
        return folder

    return write


CASES: dict[str, Callable[[Path], Path]] = {
    "ply properties": ply("property float p{}"),
    "ply lists": ply("property list uchar int p{}"),
    "ply elements": ply("element e{} 0"),
    "ply elements with a property": ply("element e{} 0\nproperty int i"),
    "ply comments": ply("comment {}"),
    "ply own comments": ply("comment flexgs-edge {}"),
    "ply obj_info": ply("obj_info {}"),
    "ply empty lines": ply(""),
    "ascii ply properties": ply("property float p{}", kind="ascii"),
    "ascii ply elements": ply("element e{} 0", kind="ascii"),
    "compressed ply properties": ply("property float p{}", "a.compressed.ply"),
    "compressed ply elements": ply("element e{} 0", "a.compressed.ply"),
    "glb nodes": gltf(nodes_beside),
    "glb nodes within nodes": gltf(nodes_within),
    "glb primitives": gltf(primitives),
    "glb shown often": gltf(shown_often),
    "glb attributes": gltf(attributes),
    "glb extensions": gltf(extensions),
    "glb extensions of splats": gltf(extensions_within),
    "glb views": gltf(views),
    "sog entries": sog_entries,
    "sog keys": sog_meta(lambda meta: meta.update({f"k{i}": i for i in range(MANY)})),
    "sog files": sog_meta(lambda meta: meta["means"].update(files=[f"f{i}" for i in range(MANY)])),
    "sog codebook": sog_meta(lambda meta: meta["sh0"].update(codebook=[0.5] * MANY)),
    "streamed leaves": streamed(leaves),
    "streamed files": streamed(files_of_leaves),
    "spz extensions": spz_extensions,
    "gzip members": gzip_members,
    "gzip name": gzip_name,
    "ksplat sections": ksplat_sections,
    "fgs 1 keys": fgs(1, KEYS),
    "fgs 2 keys": fgs(2, KEYS),
    "fgs 1 key twice": fgs(1, TWICE),
    "fgs 2 key twice": fgs(2, TWICE),
    "fgs 2 longer": fgs(2, canonical_json(list(range(10 * MANY)))),
    "cameras.json": inria,
    "cameras.json keys": keys,
    "transforms.json": transforms,
    "transforms.json folders": transforms_deep,
    "colmap bin": colmap("bin"),
    "colmap txt": colmap("txt"),
}


@pytest.mark.parametrize("case", CASES)
def test_long_headers(case: str, tmp_path: Path) -> None:
    place = CASES[case](tmp_path)
    start = time.process_time()
    try:
        if place.is_dir() or place.name == "a.json":
            read_cameras(place)
        else:
            notes = open_file(place).source.notes
            assert len(notes) < 20 and len(str(notes)) < 5000
    except InputError as error:
        assert str(error).startswith(str(place)) and len(str(error)) < 1000 + len(str(place)), str(error)[:500]
    assert time.process_time() - start < SECONDS
