"""Collect what `info` says about a `.fgs` file."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.codec.sections import ChunkEntry
from flexgs_edge.codec.v1.container import Header
from flexgs_edge.codec.v2.container import GridContainer, Preview, channel_bytes
from flexgs_edge.codec.v2.header import Channels, Chunk, GridHeader, channel_parts
from flexgs_edge.codec.v2.walk import ChunkCodes
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.packed.quantize import array_bytes
from flexgs_edge.report.info_result import InfoResult
from flexgs_edge.scene.fields import FIELDS


def contents(path: str | Path) -> InfoResult:
    """Read what a `.fgs` file holds: counts, settings, and the bytes of every channel.

    Reads only the header of most files. A version 2 file that was cut is decoded, which takes much longer: only its symbols
    tell how many bytes each channel takes.
    """
    place = Path(path)
    header = read_header(place)
    return _packed_info(place, header) if isinstance(header, Header) else _grid_info(place)


def _packed_info(path: Path, header: Header) -> InfoResult:
    """Contents of a version 1 file. The header gives the bytes of each bit-packed array."""
    channels: dict[str, dict[str, Any]] = {}
    for field in FIELDS:
        rows, width, bits = header.rows(field.name), header.width(field.name), header.bits.of(field.name)
        groups = header.groups[field.bits]
        total = array_bytes(rows, width, bits, groups)
        channels[field.bits] = {
            "field": field.name,
            "channels": width,
            "rows": rows,
            "bits": bits,
            "groups": groups,
            "range_bytes": 8 * width * groups,
            "bytes": total,
            "bytes_per_channel": total // width if width else 0,
        }
    return _fgs_result(path, header, 1, header.sh_count, channels)


def _grid_info(path: Path) -> InfoResult:
    """Contents of a version 2 file. The bytes of each channel come from the header, else from decoding the file."""
    container = GridContainer(path)
    header, length = container.header, container.header.preview.length
    known = header.channels or _decoded_channels(path, header)
    layers = [{"rows": rows, "bytes": 0} for rows in header.layers]
    for chunk, entry in zip(header.chunks(), container.read_table(), strict=True):
        layers[chunk.layer]["bytes"] += entry.section.length
    channels = {}
    for name, total in zip(channel_parts(header.sh_degree), known.bytes, strict=True):
        degree = int(name.split()[1]) if name.startswith("sh ") and name != "sh degree" else 0
        rows = (header.count, *known.rows)[degree]
        channels[name] = {
            "rows": rows,
            "step": header.steps["sh"][degree - 1] if degree else header.steps.get(name),
            "bytes": total,
            "bits_per_row": round(8 * total / rows, 3) if rows else None,
            "bits_per_gaussian": round(8 * total / header.count, 3) if header.count else None,
        }
    return replace(
        _fgs_result(path, header, 2, known.rows[0] if known.rows else 0, channels),
        chroma=header.steps["chroma"],
        model_bytes=header.model.length,
        layers=tuple(layers),
        preview={"rows": Preview(container).header.count, "bytes": length} if length else None,
        cut_from=header.cut_from,
    )


def _decoded_channels(path: Path, header: GridHeader) -> Channels:
    """Decode a file whose header does not list its channels, such as one that was cut."""
    rows = np.zeros(header.sh_degree, np.int64)

    def count(chunk: Chunk, entry: ChunkEntry, codes: ChunkCodes) -> None:
        degrees = codes.base["sh degree"]
        rows[:] += [int(np.count_nonzero(degrees > degree)) for degree in range(header.sh_degree)]

    taken = channel_bytes(path, count)
    return Channels.of(taken, rows.tolist())


def _fgs_result(
    path: Path, header: Header | GridHeader, version: int, sh_count: int, channels: dict[str, dict[str, Any]]
) -> InfoResult:
    """Fill in the fields that both versions share."""
    settings = dict(header.settings)
    count, degree = settings.get("source_count"), settings.get("source_sh_degree")
    known = isinstance(count, int) and isinstance(degree, int) and 0 <= degree <= 4
    ply = count * inria_dtype(degree).itemsize if known and count is not None and degree is not None else None
    return InfoResult(
        path=os.fspath(path),
        format="fgs",
        size=os.stat(path).st_size,
        count=header.count,
        sh_count=sh_count,
        sh_degree=header.sh_degree,
        origin=tuple(header.origin),
        source_ply_bytes=ply,
        version=version,
        channels=channels,
        settings=settings,
    )
