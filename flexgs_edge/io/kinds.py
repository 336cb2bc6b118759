"""Say what a file is by its first bytes, and what to do next, for files that are no scene or have the wrong suffix."""

import os
import re
import zipfile
import zlib
from collections.abc import Collection
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from flexgs_edge.errors import FormatError, InputError
from flexgs_edge.io.ply_layout import PlyHeader, read_header

GZIP_MAGIC = b"\x1f\x8b"
_HEAD = 1 << 16  # Bytes that are looked at
_PEEK = 64  # Bytes that are unpacked of a gzip file, to see what it holds
_LFS = b"version https://git-lfs.github.com/spec/"
_FGS = b"\x93FGS\r\n\x1a\n"
_IMAGES = {
    b"\x89PNG\r\n\x1a\n": "a PNG image",
    b"GIF8": "a GIF image",
    b"II*\0": "a TIFF image",
    b"MM\0*": "a TIFF image",
}
_MOVING = re.compile(r"t|scale_t|trbf_(center|scale)|motion_[0-9]+|omega_[0-9]+|rot_r_[0-9]+")
"""Properties of time, as 4D Gaussian splatting (t, scale_t, rot_r_*) and SpacetimeGaussians (the others) write them."""
_INCOMPLETE = "is the download or the copy complete?"
_AGAIN = "the download went wrong; fetch the file itself"
_TRAIN = "train a scene first, and give its output"
_PHOTO = f"photos go to --images; {_TRAIN}"


@dataclass(frozen=True)
class Kind:
    """What a file is."""

    words: str  # with its article: `a PNG image`
    advice: str = ""  # what to do next, where this program cannot read it
    # Suffix of the format of scenes that it follows; `None` if it holds no scene that we know.
    suffix: str | None = None
    # Suffixes of formats that are built on this one: their readers say more about what is wrong.
    hosts: tuple[str, ...] = ()

    def refused(self, name: str) -> FormatError:
        """The error for a file that this program cannot read at all."""
        return FormatError(f"{name}: this is {self.words}: {self.advice}")

    def renamed(self, name: str, suffixes: Collection[str]) -> FormatError:
        """The error for a scene that has the suffix of another format; `suffixes` are those of scenes."""
        base = os.path.basename(name)
        most = max((suffix for suffix in suffixes if base.lower().endswith(suffix)), key=len, default="")
        stem = base[: -len(most)] if most else os.path.splitext(base)[0]
        return FormatError(f"{name}: this is {self.words}: rename it to {stem or 'scene'}{self.suffix}")


def kind_of(path: Path, name: str) -> Kind | None:
    """What the file at `path` is, or `None` if its first bytes do not tell; messages call it `name`.

    Formats without a first mark (`.splat`, `.ksplat`) are never told.

    Raises `InputError` if the file cannot be read.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(_HEAD)
            if head[:3] == b"ply" and head[3:4] in (b"\n", b"\r"):
                file.seek(0)
                with suppress(FormatError):
                    return _ply_kind(read_header(name, file))
                return Kind("a PLY file", suffix=".ply")  # its reader says what is wrong
    except OSError as error:
        raise InputError(f"{name}: cannot read it ({error.strerror})") from error
    if name.lower().endswith(".lcc"):
        return Kind(
            "a scene of XGRIDS (.lcc: the index of several files)",
            "export a .ply from the program that made it, or with `npx @playcanvas/splat-transform scene.lcc scene.ply`",
        )
    if not head:
        return Kind("an empty file", _INCOMPLETE)
    if head.startswith(_LFS):
        size = re.search(rb"^size ([0-9]{1,18})$", head, re.MULTILINE)
        of = f" of {size.group(1).decode()} bytes" if size else ""
        return Kind(f"a Git LFS pointer{of}, not the file itself", "run `git lfs pull` in its repository")
    # Two or three bytes may be chance, in a format that begins with a coordinate. The next ones would make it 1e-30 or 1e20.
    if head.startswith(GZIP_MAGIC + b"\x08") and head[3:4] < b"\x20":
        return _gzip_kind(head)
    if head.startswith(b"\xff\xd8\xff") and head[3:4] >= b"\xc0":
        return Kind("a JPEG image", _PHOTO)
    if head.startswith(b"PK\x03\x04"):
        return _zip_kind(path)
    if head.startswith(b"NGSP"):
        return Kind("a .spz file", suffix=".spz")
    if head.startswith(b"glTF"):
        return Kind("a binary glTF file", suffix=".glb")
    if head.startswith((b"PXR-USDC", b"#usda ")):
        binary = head.startswith(b"PXR")
        return Kind("a USD file", suffix=".usdc" if binary else ".usda", hosts=(".usd",))
    if head.startswith(_FGS):
        return Kind("a .fgs file", suffix=".fgs")
    if head.startswith(b"\x93NUMPY"):
        return Kind("a NumPy array", "give it to Scene.from_arrays in Python, which makes a scene of arrays")
    if head[:4] == b"RIFF" and head[8:12] == b"WEBP":
        return Kind("a WebP image", "give the meta.json beside it, or a scene file")
    for magic, words in _IMAGES.items():
        if head.startswith(magic):
            return Kind(words, _PHOTO)
    return _text_kind(head.removeprefix(b"\xef\xbb\xbf").lstrip())


def _ply_kind(header: PlyHeader) -> Kind:
    """What a PLY with a valid header holds, by its properties."""
    by_name = {element.name: element for element in header.elements}
    vertex, faces = by_name.get("vertex"), by_name.get("face") or by_name.get("tristrips")
    has = {p.name for p in vertex.properties} if vertex is not None else set()
    if "packed_position" in has:
        return Kind("a compressed PLY", suffix=".compressed.ply")
    moving = sorted(name for name in has if _MOVING.fullmatch(name))
    if moving not in ([], ["t"]) and "opacity" in has:  # `t` alone may be anything
        return Kind(
            f"a PLY of Gaussians that move (4D: {', '.join(moving[:4])})",
            "this program reads scenes that stand still; export one moment of it as a plain PLY with the program that trained it",
        )
    if vertex is None or has & {"f_dc_0", "opacity", "scale_2", "rot_0"}:
        if {"scale_0", "scale_1", "rot_0"} <= has and "scale_2" not in has:
            return Kind(
                "a PLY of 2D Gaussian splats (2DGS: scale_0 and scale_1, no scale_2)",
                "they are flat discs with a renderer of their own, which this program does not have; train 3D Gaussians",
            )
        return Kind("a PLY", suffix=".ply")
    if faces is not None and faces.count:
        return Kind(f"a mesh with {faces.count} faces, not Gaussians", _TRAIN)
    if {"x", "y", "z"} <= has:
        return Kind(f"a point cloud of {vertex.count} points, not Gaussians", _TRAIN)
    return Kind("a PLY", suffix=".ply")


def _gzip_kind(head: bytes) -> Kind:
    """What a gzip file holds, as far as its first bytes tell."""
    inner = b""
    with suppress(zlib.error):
        inner = zlib.decompressobj(wbits=31).decompress(head, _PEEK)
    if inner.startswith(b"NGSP"):
        return Kind("a .spz file", suffix=".spz")
    if inner.startswith(b"ply") and inner[3:4] in (b"\n", b"\r"):
        return Kind("a PLY packed with gzip", suffix=".ply.gz")
    return Kind("a gzip file", "if it holds a scene, let its name end in the scene's suffix and .gz", hosts=(".spz",))


def _zip_kind(path: Path) -> Kind:
    """What a zip archive holds, by the names in it."""
    names: set[str] = set()
    with suppress(zipfile.BadZipFile, ValueError, RuntimeError, OSError), zipfile.ZipFile(path) as archive:
        names = {info.filename.rsplit("/", 1)[-1] for info in archive.infolist()}
    if "meta.json" in names:
        return Kind("a .sog file", suffix=".sog")
    if "data.pkl" in names:
        return Kind("a PyTorch checkpoint", "export a PLY from it with the program that trained it")
    if any(name.endswith((".usd", ".usda", ".usdc")) for name in names):
        return Kind("a .usdz file", suffix=".usdz")
    if any(name.endswith(".npy") for name in names):
        return Kind("a NumPy archive", "give its arrays to Scene.from_arrays in Python")
    return Kind("a zip archive", "unpack it, and give the scene in it", hosts=(".sog", ".usdz"))


def _text_kind(text: bytes) -> Kind | None:
    """What a text is that begins like HTML, XML or JSON."""
    start = text[:512].lower()
    if start.startswith((b"<!doctype html", b"<html", b"<head", b"<body", b"<script")):
        return Kind("an HTML page", _AGAIN)
    if start.startswith((b"<?xml", b"<!doctype", b"<error")):
        return Kind("an HTML page" if b"<html" in start else "an XML text", _AGAIN)
    if not re.match(rb'\{\s*["}]|\[\s*[{\]]', text):
        return None
    if b'"asset"' in text and (b'"buffers"' in text or b'"meshes"' in text or b'"nodes"' in text):
        return Kind("a glTF file", suffix=".gltf")
    if b'"transform_matrix"' in text or b'"img_name"' in text:
        return Kind("a file of cameras", "give it to --cameras, and the scene's own file here")
    advice = "a SOG scene's is called meta.json, a streamed one's lod-meta.json"
    return Kind("a JSON file", advice, hosts=(".gltf", "meta.json", "lod-meta.json"))
