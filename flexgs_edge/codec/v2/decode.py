"""Decode a chunk of a coded scene with NumPy."""

from __future__ import annotations

import numpy as np

from flexgs_edge.codec.v2.chunk_plan import check_end
from flexgs_edge.codec.v2.model import Model
from flexgs_edge.codec.v2.ports import DecodePort
from flexgs_edge.codec.v2.rans import Decoder, lane_count
from flexgs_edge.codec.v2.walk import ChunkCodes, walk_chunk


def decode_chunk(
    model: Model, rows: int, data: bytes, base_only: bool = False, cost: np.ndarray | None = None
) -> ChunkCodes:
    """The codes of a chunk; raises `StreamError` for bytes that no encoder wrote.

    Parameters
    ----------
    model : Model
        Of the file.
    rows : int
        Rows of the chunk.
    data : bytes
        All of the chunk.
    base_only : bool, optional
        Leave out the SH.
    cost : np.ndarray, optional
        [alphabets] f64: bits of each alphabet are added to it.
    """
    stream = Decoder(data, lane_count(rows))
    codes = walk_chunk(rows, model.depth, model.sh_degree, DecodePort(model, stream, cost), None, base_only)
    if not base_only:
        check_end(data, rows, stream.finish())
    return codes
