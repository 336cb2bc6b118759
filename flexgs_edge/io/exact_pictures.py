"""Pictures that hold numbers: WebP and PNG as exact bytes, with their size checked before anything is decoded."""

import io
import struct

import numpy as np

from flexgs_edge.errors import FormatError

_WEBP_PLACE = 20  # First byte of the first chunk of a WebP
_LARGEST_CHUNKS = 64  # Chunks of a WebP that are looked through
_DAMAGED = (OSError, SyntaxError, struct.error, ValueError, EOFError, RuntimeError, IndexError, KeyError)
"""What Pillow raises for pictures that it cannot decode."""


def picture_size(data: bytes, place: str) -> tuple[int, int]:
    """Width and height that a picture claims, without decoding it.

    Raises `FormatError` if it is neither a still WebP nor a PNG of 8-bit channels.
    """
    try:
        if data[:4] == b"RIFF" and data[8:12] == b"WEBP":
            return _webp_size(data, place)
        if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR":
            width, height, depth = struct.unpack_from(">IIB", data, 16)
            if depth > 8:
                raise FormatError(f"{place}: expected a picture of 8-bit channels, found {depth} bits")
            return width, height
    except struct.error:
        raise FormatError(f"{place}: {len(data)} bytes are no whole picture; is it complete?") from None
    raise FormatError(f"{place}: expected a WebP or PNG picture, found bytes {data[:12]!r}")


def read_pixels(data: bytes, place: str) -> np.ndarray:
    """Decode a picture whose size was checked: [H, W, 4] u8, red green blue alpha, as they are stored.

    Raises `FormatError` if it cannot be decoded.
    """
    from PIL.PngImagePlugin import PngImageFile
    from PIL.WebPImagePlugin import WebPImageFile

    size = picture_size(data, place)
    # Not `Image.open`: its limit on pixels belongs to the whole process, and the size is checked already.
    kind = WebPImageFile if data[:4] == b"RIFF" else PngImageFile
    try:
        with kind(io.BytesIO(data)) as image:
            if image.size != size:
                raise ValueError(f"{image.size[0]}x{image.size[1]} pixels where {size[0]}x{size[1]} were announced")
            image.load()
            if image.mode in ("I;16", "I", "F", "CMYK"):
                raise ValueError(f"pixels of kind {image.mode}")
            return np.asarray(image.convert("RGBA"))
    except _DAMAGED as error:
        raise FormatError(f"{place}: the picture cannot be decoded ({error}); is it complete?") from error


def is_lossy(data: bytes) -> bool:
    """Whether a picture is a lossy WebP, whose pixels are not the numbers that went in."""
    return data[:4] == b"RIFF" and any(kind == b"VP8 " for kind, _ in _webp_chunks(data))


def write_pixels(pixels: np.ndarray) -> bytes:
    """Code a picture ([H, W, 4] u8) as lossless WebP, with the colours of transparent pixels kept."""
    from PIL import Image

    place = io.BytesIO()
    Image.fromarray(pixels).save(place, "WEBP", lossless=True, exact=True, quality=50, method=4)
    return place.getvalue()


def _webp_size(data: bytes, place: str) -> tuple[int, int]:
    kind = data[12:16]
    if kind == b"VP8L":
        (bits,) = struct.unpack_from("<I", data, _WEBP_PLACE + 1)
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    if kind == b"VP8 ":
        width, height = struct.unpack_from("<HH", data, _WEBP_PLACE + 6)
        return width & 0x3FFF, height & 0x3FFF
    if kind == b"VP8X":
        flags, width, more, height, highest = struct.unpack_from("<IHBHB", data, _WEBP_PLACE)
        if flags & 2:
            raise FormatError(f"{place}: expected one picture, found an animation")
        return (width | more << 16) + 1, (height | highest << 16) + 1
    raise FormatError(f"{place}: expected a WebP picture, found a first chunk {kind!r}")


def _webp_chunks(data: bytes) -> list[tuple[bytes, int]]:
    """Kinds and places of the first chunks of a WebP."""
    found: list[tuple[bytes, int]] = []
    at = 12
    while at + 8 <= len(data) and len(found) < _LARGEST_CHUNKS:
        found.append((data[at : at + 4], at))
        at += 8 + struct.unpack_from("<I", data, at + 4)[0] + 1 & ~1
    return found
