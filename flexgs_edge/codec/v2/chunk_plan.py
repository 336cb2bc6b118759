"""Split a coded scene into chunks of rows."""

from __future__ import annotations

from dataclasses import dataclass

from flexgs_edge.codec.v2.rans import StreamError

CHUNK_ROWS = 65536


@dataclass(frozen=True, eq=False)
class Chunk:
    """Rows [start, stop) of a scene, all in one layer."""

    layer: int
    start: int
    stop: int


def plan_chunks(layers: list[int], chunk_rows: int = CHUNK_ROWS) -> list[Chunk]:
    """The chunks of a scene, from the number of rows in each layer."""
    chunks, at = [], 0
    for layer, count in enumerate(layers):
        for start in range(at, at + count, chunk_rows):
            chunks.append(Chunk(layer, start, min(start + chunk_rows, at + count)))
        at += count
    return chunks


def least_bytes(rows: int) -> int:
    """Least bytes of a chunk of so many rows: a bit a row, rounded up to an even number."""
    return -(-rows // 16) * 2


def check_end(data: bytes, rows: int, used: int) -> None:
    """Raise `StreamError` unless `used` bytes are the whole stream, or only zeros pad it to the least size of a chunk."""
    if any(data[used:]) or (len(data) > used and len(data) != least_bytes(rows)):
        raise StreamError(f"stream: wanted {used} bytes, got {len(data)}")
