"""Write tests/fuzz/seeds and tests/fuzz/corpus anew: small valid files that mutations start from, and files that must be refused.

python tests/fuzz/regenerate.py

A file that was found by fuzzing goes into `corpus` as it was found; this script leaves files that it does not know alone.
"""

from __future__ import annotations

import gzip
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "helpers"))


from camera_files import colmap_records, write_colmap, write_inria, write_transforms
from exchanged import planes_of, scene
from fgs_damage import edit_header, flip, overwrite, put, reseal_section, write_header
from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.io.exchange import write_foreign
from flexgs_edge.io.reading import Writing
from flexgs_edge.packed.bitpack import BitSpec
from gltf_files import GltfBuilder, splat_arrays
from grid_scenes import make_grid
from ksplat_files import Part, ksplat
from quantized_scenes import make_scene, quantize_all
from scene_files import edit, header, random_rows, write_rows
from sog_files import sog_bytes, write_streamed
from synthetic import look_from, make_camera

FOLDER = Path(__file__).parent
SEEDS, CORPUS = FOLDER / "seeds", FOLDER / "corpus"

Change = Callable[[Path], object]


def write_seeds() -> None:
    """Files that are read without a word, as small as they can be."""
    SEEDS.mkdir(exist_ok=True)
    spec = BitSpec(9, 4, 4, 5, 3, 2)
    write_container(SEEDS / "v1.fgs", quantize_all(make_scene(9), spec), {"near": 0.2}, force=True)
    write_grid(SEEDS / "v2.fgs", make_grid(9, 1, layers=2), {"near": 0.2}, force=True)
    write_grid(SEEDS / "small.fgs", make_grid(3, 0), {}, force=True)
    preview = (SEEDS / "small.fgs").read_bytes()
    (SEEDS / "small.fgs").unlink()
    write_grid(SEEDS / "v2_preview.fgs", make_grid(9, 1), {"near": 0.2}, force=True, preview=preview)
    rows = random_rows(3, 1)
    write_rows(SEEDS / "binary.ply", rows)
    write_rows(SEEDS / "big.ply", random_rows(3, 0, order=">"))
    text = "\n".join(" ".join(f"{value:.6g}" for value in row) for row in rows.tolist())
    (SEEDS / "ascii.ply").write_bytes(header(rows, "ascii") + text.encode() + b"\n")
    cameras = []
    for view in range(3):
        rotation, translation = look_from(view)
        cameras.append(make_camera(rotation=rotation, translation=translation, name=f"view{view}.png"))
    write_inria(SEEDS / "cameras.json", cameras)
    write_transforms(SEEDS / "transforms.json", cameras)
    for text_form in (True, False):
        write_colmap(SEEDS / ("text" if text_form else "binary"), *colmap_records(cameras), text=text_form)
    write_gltf_seeds()
    (SEEDS / "version1.sog").write_bytes(sog_bytes(1, kind="png"))
    (SEEDS / "version2.sog").write_bytes(sog_bytes(2))
    write_streamed(SEEDS / "streamed")


def write_gltf_seeds() -> None:
    """Splats under two nodes, one of which shears, with narrow, interleaved and sparse accessors."""
    builder = GltfBuilder()
    arrays = splat_arrays(3, 1)
    opacities = (arrays["OPACITY"] * 255).astype(np.uint8)
    quats = (arrays["ROTATION"] * 32767).astype(np.int16)
    accessors = {
        name: builder.accessor(values) for name, values in arrays.items() if name not in ("OPACITY", "ROTATION")
    }
    accessors["OPACITY"] = builder.accessor(opacities, stride=4, normalized=True)
    accessors["ROTATION"] = builder.accessor(quats, normalized=True)
    indices, values = builder.view(b"\1\0"), builder.view(np.ones(3, np.float32).tobytes())
    builder.record["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": indices, "componentType": 5121},
        "values": {"bufferView": values},
    }
    builder.node(mesh=builder.mesh(builder.primitive(accessors)), rotation=[0, 0.6, 0, 0.8], scale=[1, 2, 3])
    child = builder.node(False, mesh=0, matrix=[0, 2, 0, 0, -2, 0, 0, 0, 0, 0, 2, 0, 1e4, 0, 0, 1])
    builder.node(children=[child], translation=[1, 2, 3])
    builder.glb(SEEDS / "splats.glb")
    builder.gltf(SEEDS / "splats.gltf")


def write_other_seeds() -> None:
    """Small files of other programs' formats."""
    for version, name in ((3, "third.spz"), (4, "fourth.spz")):
        write_foreign(SEEDS / name, scene(3, 1), force=True, writing=Writing(version, antialiased=True))
    unpacked = gzip.decompress((SEEDS / "third.spz").read_bytes())
    # Version 2 has rotations of 3 bytes, and version 1 also positions of 6.
    arrays, place = [], 16
    for width in (9, 1, 3, 3, 4, 9):
        arrays.append(np.frombuffer(unpacked, "u1", 3 * width, place).reshape(3, width))
        place += 3 * width
    halves = np.array([[1, -2, 0.5], [0, 3, 1], [-1, 1, 2]], "<f2").view("u1")
    for version, name, first in ((1, "first.spz", halves), (2, "second.spz", arrays[0])):
        parts = [first, *arrays[1:4], arrays[4][:, :3], arrays[5]]
        body = unpacked[:4] + struct.pack("<I", version) + unpacked[8:16] + b"".join(part.tobytes() for part in parts)
        (SEEDS / name).write_bytes(gzip.compress(body, mtime=0))
    write_foreign(SEEDS / "tiny.splat", scene(3, 0), force=True)
    write_foreign(SEEDS / "tiny.compressed.ply", scene(3, 1), force=True)
    for level, name in ((0, "plain.ksplat"), (2, "packed.ksplat")):
        parts = [
            Part(planes_of(scene(count, 1, spread=0.9)), 1, sizes, 2) for count, sizes in ((4, (2, 1, 1)), (1, (1,)))
        ]
        (SEEDS / name).write_bytes(ksplat(level, parts, spare_sections=1))


def nested(depth: int) -> list[Any]:
    """Lists in lists."""
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def cut(length: int) -> Change:
    """Only the first bytes."""
    return lambda path: path.write_bytes(path.read_bytes()[:length])


def words(old: str, new: str) -> Change:
    """One piece of a text replaced."""
    return lambda path: path.write_bytes(edit(path.read_bytes(), old, new))


def entry(key: str, value: Any) -> Change:
    """A value of the first camera, or of the first frame."""

    def change(path: Path) -> None:
        record = json.loads(path.read_bytes())
        (record["frames"] if isinstance(record, dict) else record)[0][key] = value
        path.write_text(json.dumps(record))

    return change


def claim(**values: Any) -> Change:
    """Values of a container's header, sealed."""
    return lambda path: edit_header(path, lambda record: record.update(values))


def _less(key: str) -> Callable[[dict[str, Any]], None]:
    """A number of the header made one smaller."""

    def change(record: dict[str, Any]) -> None:
        record[key] -= 1

    return change


def sealed(section: str, change: Callable[[bytearray], object]) -> Change:
    """A change of a section, under a checksum that is right again."""
    return lambda path: reseal_section(path, section, change)


def first_float(value: float) -> Change:
    """The first number of the ranges of version 1."""
    return sealed("ranges", lambda body: struct.pack_into("<f", body, 0, value))


HOSTILE: dict[str, tuple[str, Change]] = {
    "v1-cut.fgs": ("v1.fgs", cut(2000)),
    "v1-flipped-bit.fgs": ("v1.fgs", lambda path: flip(path, "chunk 0", 3, 1)),
    "v1-version-3.fgs": ("v1.fgs", lambda path: overwrite(path, 8, "<H", 3)),
    "v1-must-understand.fgs": ("v1.fgs", lambda path: overwrite(path, 10, "<H", 4)),
    "v1-most-rows.fgs": ("v1.fgs", claim(count=2**32 - 1)),
    "v1-negative-rows.fgs": ("v1.fgs", claim(count=-1)),
    "v1-nan-range.fgs": ("v1.fgs", first_float(float("nan"))),
    "v1-infinite-range.fgs": ("v1.fgs", first_float(float("inf"))),
    "v1-deep-header.fgs": (
        "v1.fgs",
        lambda path: write_header(path, b'{"count":' + b"[" * 900 + b"]" * 900 + b"}", 2048),
    ),
    "v2-cut.fgs": ("v2.fgs", cut(36)),
    "v2-flipped-bit.fgs": ("v2.fgs", lambda path: flip(path, "model", 5, 8)),
    "v2-most-rows.fgs": ("v2.fgs", claim(count=2**32 - 1, layers=[2**32 - 1], chunk_rows=65536)),
    "v2-rows-of-nothing.fgs": ("v2.fgs", claim(count=100_000, layers=[100_000], chunk_rows=65536)),
    "v2-many-layers.fgs": ("v2.fgs", claim(layers=[0] * 300 + [9])),
    "v2-depth-22.fgs": ("v2.fgs", claim(depth=22)),
    "v2-step-of-zero.fgs": ("v2.fgs", lambda path: edit_header(path, put("steps", "dc", value=0.0))),
    "v2-infinite-step.fgs": ("v2.fgs", lambda path: edit_header(path, put("steps", "scale", value=1e300))),
    "v2-model-of-zeros.fgs": ("v2.fgs", sealed("model", lambda body: body.__setitem__(slice(8, 200), bytes(192)))),
    "v2-chunk-of-no-bytes.fgs": ("v2.fgs", sealed("chunk table", lambda body: struct.pack_into("<I", body, 0, 0))),
    "v2-chunk-beyond-the-end.fgs": (
        "v2.fgs",
        sealed("chunk table", lambda body: struct.pack_into("<I", body, 0, 2**32 - 2)),
    ),
    "v2-preview-of-no-bytes.fgs": ("v2_preview.fgs", claim(preview_bytes=0)),
    "v2-preview-beyond-the-end.fgs": ("v2_preview.fgs", claim(preview_bytes=2**31 - 1)),
    "v2-preview-cut.fgs": ("v2_preview.fgs", lambda path: edit_header(path, _less("preview_bytes"))),
    "count-1e18.ply": ("binary.ply", words("element vertex 3", "element vertex 1000000000000000000")),
    "count-of-many-digits.ply": ("binary.ply", words("element vertex 3", f"element vertex {'9' * 5000}")),
    "cut.ply": ("binary.ply", cut(900)),
    "list-for-x.ply": ("binary.ply", words("property float x", "property list uchar float x")),
    "nan.ply": ("ascii.ply", words("end_header\n", "end_header\nnan ")),
    "words.ply": ("ascii.ply", words("end_header\n", "end_header\nfour ")),
    "no-end.ply": ("ascii.ply", words("end_header\n", "end_headers\n")),
    "element-before.ply": (
        "big.ply",
        words("element vertex 3", "element face 4294967295\nproperty list int double i\nelement vertex 3"),
    ),
    "deep-rotation.json": ("cameras.json", entry("rotation", nested(900))),
    "deep-name.json": ("cameras.json", entry("img_name", nested(900))),
    "huge-rotation.json": ("cameras.json", entry("rotation", [[1e200, 0, 0], [0, 1e200, 0], [0, 0, 1e200]])),
    "ragged-position.json": ("cameras.json", entry("position", [1, [2], 3])),
    "wide.json": ("cameras.json", entry("width", 1e9)),
    "number-of-many-digits.json": ("cameras.json", entry("fx", 10**400)),
    "deep-matrix.json": ("transforms.json", entry("transform_matrix", nested(900))),
    "nan-matrix.json": ("transforms.json", entry("transform_matrix", [[float("nan")] * 4] * 4)),
    "brackets.json": ("transforms.json", lambda path: path.write_text("[" * 100_000)),
}
"""By name: the seed, and what is done to it."""


def write_corpus() -> None:
    """Files that every reader must refuse."""
    CORPUS.mkdir(exist_ok=True)
    for name, (seed, change) in HOSTILE.items():
        (CORPUS / name).write_bytes((SEEDS / seed).read_bytes())
        change(CORPUS / name)
    for name, old, new in (
        ("colmap-huge-quaternion", "7 ", "7 1e200 "),
        ("colmap-many-images", "7 ", "99999999999999999999 "),
    ):
        folder = CORPUS / name
        folder.mkdir(exist_ok=True)
        (folder / "cameras.txt").write_bytes((SEEDS / "text" / "cameras.txt").read_bytes())
        (folder / "images.txt").write_bytes(edit((SEEDS / "text" / "images.txt").read_bytes(), f"\n{old}", f"\n{new}"))
    folder = CORPUS / "colmap-claims-images"
    folder.mkdir(exist_ok=True)
    (folder / "cameras.bin").write_bytes((SEEDS / "binary" / "cameras.bin").read_bytes())
    images = (SEEDS / "binary" / "images.bin").read_bytes()
    (folder / "images.bin").write_bytes(struct.pack("<Q", 2**63) + images[8:])


if __name__ == "__main__":
    write_seeds()
    write_other_seeds()
    write_corpus()
