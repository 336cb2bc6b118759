"""Decode a chunk of a version 2 file with NumPy: the specification of the decoding kernel."""

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
    """Decode the codes of a chunk; raises `StreamError` for bytes that no encoder writes.

    `model`: the model of the file. `rows`: rows of the chunk. `data`: the whole chunk. `base_only`: stop before the SH;
    False by default. `cost`: [alphabets] f64, to which the bits of each alphabet are added.
    """
    stream = Decoder(data, lane_count(rows))
    codes = walk_chunk(rows, model.depth, model.sh_degree, DecodePort(model, stream, cost), None, base_only)
    if not base_only:
        check_end(data, rows, stream.finish())
    return codes
