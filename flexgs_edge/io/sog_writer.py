"""Write SOG scenes of PlayCanvas, version 2: a zip of lossless WebP pictures and their `meta.json`.

Rows are pixels in the order that they come in. SH above degree 0 become a palette, so this is where the format loses most.
"""

import json
import zipfile
from typing import Any, BinaryIO

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.errors import InputError
from flexgs_edge.io.codes import rounded_quats
from flexgs_edge.io.exact_pictures import write_pixels
from flexgs_edge.io.reading import Writing
from flexgs_edge.io.sh_palette import best_codebook, nearest_codes, sh_palette
from flexgs_edge.io.sog import META, PALETTE_COLUMNS, QUAT_MODE
from flexgs_edge.scene.source import SceneSource

_LARGEST_SIDE = 16380  # Pixels of a WebP's side, a multiple of 4
_SMALL = 1024  # Scenes of at most so many Gaussians keep all their SH
_LARGEST_PALETTE = 65536
_ROUNDING = 1 / 2048
_ROUNDING_SHARE = 1 / 32
"""Entries of the SH palette are rounded by the first number (root mean square, an eighth of a level of a display), or so
that the second share is added to the squared error of the palette, if that is more."""
_EVEN_CODES = 112  # Most even steps of SH on each side of zero; 31 codes are left for values beyond
_CHUNK_ROWS = 65536
_DATE = (1980, 1, 1, 0, 0, 0)


def write_sog(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a `.sog`; see `write_foreign`. Raises `InputError` if the scene has more Gaussians than a picture has pixels."""
    if source.count > _LARGEST_SIDE**2:
        raise InputError(
            f"{source.name}: a .sog holds at most {_LARGEST_SIDE**2} Gaussians, this scene has {source.count}: write a .spz"
        )
    meta: dict[str, Any] = {"version": 2, "asset": {"generator": f"flexgs-edge {__version__}"}, "count": source.count}
    if writing.antialiased:
        meta["antialias"] = True
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        meta["means"] = _put_means(archive, source)
        meta["scales"], meta["quats"] = _put_shapes(archive, source)
        meta["sh0"] = _put_colours(archive, source)
        if source.sh_degree:
            meta["shN"] = _put_sh(archive, source)
        _put(archive, META, json.dumps(meta, separators=(",", ":"), allow_nan=False).encode())


def palette_size(count: int) -> int:
    """Entries of the SH palette for a number of Gaussians: the largest power of two that is not above it, or 65536.

    Small scenes have an entry for each Gaussian, since a few kilobytes are no reason to lose their colours.

    >>> palette_size(1), palette_size(1000), palette_size(3000), palette_size(10**6)
    (1, 1000, 2048, 65536)
    """
    if count <= _SMALL:
        return count
    return min(1 << count.bit_length() - 1, _LARGEST_PALETTE)


def _put_means(archive: zipfile.ZipFile, source: SceneSource) -> dict[str, Any]:
    means = _values(source, "means").astype(np.float64)
    logs = np.copysign(np.log1p(np.abs(means)), means)
    # Few digits, which are the same wherever the last bit of a logarithm differs.
    lowest, highest = ([_short(value) for value in ends] for ends in (logs.min(axis=0), logs.max(axis=0)))
    span = np.subtract(highest, lowest)
    shares = (logs - lowest) / np.where(span > 0, span, 1)
    codes = np.clip(np.rint(shares * 65535), 0, 65535).astype(np.uint16)
    _put_rows(archive, "means_l.webp", (codes & 255).astype(np.uint8))
    _put_rows(archive, "means_u.webp", (codes >> 8).astype(np.uint8))
    return {"mins": lowest, "maxs": highest, "files": ["means_l.webp", "means_u.webp"]}


def _put_shapes(archive: zipfile.ZipFile, source: SceneSource) -> tuple[dict[str, Any], dict[str, Any]]:
    """Write scales and quaternions; the form of each Gaussian is that whose quaternion rounds best."""
    scales = np.empty((source.count, 3), np.float32)
    quats = np.empty((source.count, 4), np.uint8)
    for rows in source.chunks(_CHUNK_ROWS):
        planes = source.read(rows, ["log_scales", "quats"])
        codes, mode, axes = rounded_quats(planes["quats"].T.astype(np.float64), planes["log_scales"].T)
        quats[rows, :3], quats[rows, 3] = codes, QUAT_MODE + mode
        scales[rows] = np.take_along_axis(planes["log_scales"].T, axes, axis=1)
    codebook = best_codebook(scales.reshape(-1))
    _put_rows(archive, "scales.webp", nearest_codes(codebook, scales))
    _put_rows(archive, "quats.webp", quats)
    return {"codebook": _listed(codebook), "files": ["scales.webp"]}, {"files": ["quats.webp"]}


def _put_colours(archive: zipfile.ZipFile, source: SceneSource) -> dict[str, Any]:
    colours = _values(source, "sh_dc")
    codebook = best_codebook(colours.reshape(-1))
    pixels = np.empty((len(colours), 4), np.uint8)
    pixels[:, :3] = nearest_codes(codebook, colours)
    logits = _values(source, "opacity_logits")[:, 0].astype(np.float64)
    pixels[:, 3] = np.rint(255 / (1 + np.exp(-np.clip(logits, -50, 50))))
    _put_rows(archive, "sh0.webp", pixels)
    return {"codebook": _listed(codebook), "files": ["sh0.webp"]}


def _put_sh(archive: zipfile.ZipFile, source: SceneSource) -> dict[str, Any]:
    values = _values(source, "sh_rest")
    labels, palette = sh_palette(values, palette_size(source.count))
    codebook = _even_codebook(palette, values, labels)
    width = palette.shape[1] // 3
    codes = nearest_codes(codebook, palette).reshape(-1, 3, width).transpose(0, 2, 1)
    picture = np.zeros((-(-len(palette) // PALETTE_COLUMNS) * PALETTE_COLUMNS * width, 4), np.uint8)
    picture[: codes.shape[0] * width, :3] = codes.reshape(-1, 3)
    picture[:, 3] = 255
    _put(archive, "shN_centroids.webp", write_pixels(picture.reshape(-1, PALETTE_COLUMNS * width, 4)))
    _put_rows(archive, "shN_labels.webp", np.stack([labels & 255, labels >> 8], axis=1).astype(np.uint8))
    return {
        "count": len(palette), "bands": source.sh_degree, "codebook": _listed(codebook),
        "files": ["shN_centroids.webp", "shN_labels.webp"],
    }  # fmt: skip


def _even_codebook(palette: np.ndarray, values: np.ndarray, labels: np.ndarray) -> np.ndarray:
    """[at most 256] f64, multiples of a step that adds little to the error of the palette, and codes for values far off.

    Even steps cost fewer bits than the best cuts do for the same error, since frequent codes are short.
    """
    parts = range(0, len(values), _CHUNK_ROWS)
    error = sum(
        float(
            np.square(values[at : at + _CHUNK_ROWS].astype(np.float64) - palette[labels[at : at + _CHUNK_ROWS]]).sum()
        )
        for at in parts
    )
    rounding = max(_ROUNDING, float(np.sqrt(_ROUNDING_SHARE * error / values.size)))
    counts = np.bincount(labels)
    step, least, codebook = _short(np.sqrt(12) * rounding, 2), np.inf, np.zeros(1)
    while True:
        wider = _stepped(palette, counts, step)
        loss = float((np.square(palette - wider[nearest_codes(wider, palette)]).sum(axis=1) * counts).sum())
        if loss >= least:
            return codebook
        # Small steps reach too few of the values where SH are strong.
        step, least, codebook = _short(1.25 * step, 2), loss, wider


def _stepped(palette: np.ndarray, counts: np.ndarray, step: float) -> np.ndarray:
    """Multiples of a step about zero, and the best codes for the values beyond."""
    reach = min(int(np.ceil(np.abs(palette).max() / step)), _EVEN_CODES)
    codes = np.arange(-reach, reach + 1) * step
    far = np.abs(palette) > (reach + 0.5) * step
    if far.any():
        weights = np.broadcast_to(counts[:, None], palette.shape)[far]
        codes = np.union1d(codes, best_codebook(palette[far], weights, 256 - len(codes)))
    return np.asarray(codes.astype(np.float32).astype(np.float64))


def _values(source: SceneSource, field: str) -> np.ndarray:
    """[N, width] f32."""
    values = np.empty((source.count, source.width(field)), np.float32)
    for rows in source.chunks(_CHUNK_ROWS):
        values[rows] = source.read(rows, [field])[field].T
    return values


def _put_rows(archive: zipfile.ZipFile, name: str, codes: np.ndarray) -> None:
    """Write codes ([N, 1 to 4] u8) as a nearly square picture with sides that are multiples of 4."""
    count, channels = codes.shape
    width = 4 * int(np.ceil(np.sqrt(count) / 4))
    height = 4 * -(-count // (4 * width))
    picture = np.zeros((height * width, 4), np.uint8)
    picture[:, 3] = 255
    picture[:count, :channels] = codes
    _put(archive, name, write_pixels(picture.reshape(height, width, 4)))


def _put(archive: zipfile.ZipFile, name: str, data: bytes) -> None:
    info = zipfile.ZipInfo(name, _DATE)
    info.create_system, info.external_attr = 3, 0o644 << 16
    archive.writestr(info, data)


def _listed(codebook: np.ndarray) -> list[float]:
    """256 numbers, with as few digits as float32 needs; the last one repeats."""
    short = [float(str(value)) for value in codebook.astype(np.float32)]
    return short + short[-1:] * (256 - len(short))


def _short(value: float, digits: int = 8) -> float:
    return float(f"{value:.{digits}g}")
