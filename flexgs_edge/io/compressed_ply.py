"""Read and write compressed PLY files (PlayCanvas, SuperSplat): values in the ranges of chunks of 256 Gaussians.

Element `chunk` has the ranges of positions, log-scales and colours; element `vertex` four words a Gaussian; element `sh` a
byte for each SH coefficient, in INRIA's order.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FormatError
from flexgs_edge.io.codes import nearest, opacities, with_largest, without_largest
from flexgs_edge.io.decoded import DecodedSource, opacity_logits
from flexgs_edge.io.ply_layout import PROGRAM, Element, PlyHeader, left_out, read_header
from flexgs_edge.io.reading import Reading, Writing
from flexgs_edge.scene.source import REST_WIDTHS, Planes, Rows, SceneSource

CHUNK = 256  # Gaussians of a chunk; the last one may have fewer
_RANGES = {
    "means": (("min_x", "min_y", "min_z"), ("max_x", "max_y", "max_z")),
    "log_scales": (("min_scale_x", "min_scale_y", "min_scale_z"), ("max_scale_x", "max_scale_y", "max_scale_z")),
    "sh_dc": (("min_r", "min_g", "min_b"), ("max_r", "max_g", "max_b")),
}  # Properties of a chunk by field; files without those of colours have colours of 0 to 1
_WORDS = {
    "means": "packed_position",
    "quats": "packed_rotation",
    "log_scales": "packed_scale",
    "sh_dc": "packed_color",
    "opacity_logits": "packed_color",
}
_VERTEX = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_BITS = ((21, 11), (11, 10), (0, 11))  # Shift and width of x, y and z in a word of positions or scales
_QUAT_MAX = (1 << 10) - 1
_SH_REACH = 4.0  # SH codes reach so far on both sides
_SCALE_LIMIT = 20.0
"""Log-scales are clamped to this, as others do: one outlier would take the digits of its whole chunk."""
_CHUNK_ROWS = 64 * CHUNK
_CUT_CHUNKS = 64  # Boxes of more chunks are halved along their longest side: docs/results/tuning.md#cut_chunks


class CompressedPlySource(DecodedSource):
    """A compressed PLY: its words, decoded when they are read.

    `name`: the user's path, for messages. `ranges`: two arrays [chunks, 3] f64 by field: least and largest values;
    colours are optional. `words`: [N] u32 by property. `sh`: [N, width] u8.
    """

    def __init__(
        self, name: str, ranges: dict[str, tuple[np.ndarray, np.ndarray]], words: dict[str, np.ndarray], sh: np.ndarray
    ) -> None:
        held = sum(a.nbytes + b.nbytes for a, b in ranges.values()) + sum(w.nbytes for w in words.values()) + sh.nbytes
        super().__init__(name, len(sh), REST_WIDTHS[sh.shape[1]], held)
        self._ranges, self._words, self._sh = ranges, words, sh

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        if field == "sh_rest":
            return _sh_values(self._sh[rows].T)
        words = self._words[_WORDS[field]][rows]
        if field == "opacity_logits":
            return opacity_logits((words & 0xFF)[None] / 255.0)
        if field == "quats":
            return _quats(words)
        bits = ((24, 8), (16, 8), (8, 8)) if field == "sh_dc" else _BITS
        shares = np.stack([(words >> np.uint32(at) & ((1 << width) - 1)) / ((1 << width) - 1) for at, width in bits])
        if field in self._ranges:
            numbers = (np.arange(rows.start, rows.stop) if isinstance(rows, slice) else rows) // CHUNK
            low, high = (end[numbers].T for end in self._ranges[field])
            shares = low * (1 - shares) + high * shares
        return (shares - 0.5) / SH_C0 if field == "sh_dc" else shares


def _sh_values(codes: np.ndarray) -> np.ndarray:
    """Middles of the 256 intervals, and the ends themselves for the first and the last."""
    shares = (codes + 0.5) / 256
    shares = np.where(codes == 0, 0.0, np.where(codes == 255, 1.0, shares))
    return (shares - 0.5) * (2 * _SH_REACH)


def _quats(words: np.ndarray) -> np.ndarray:
    """[4, n] w x y z: the largest component is left out, and its place is in the two top bits."""
    shares = np.stack([(words >> np.uint32(at) & _QUAT_MAX) / _QUAT_MAX for at in (20, 10, 0)])
    smaller = (shares - 0.5) * np.sqrt(2)
    return with_largest((words >> np.uint32(30)).astype(np.int64), smaller)


def read_compressed_ply(path: Path, name: str, reading: Reading) -> CompressedPlySource:
    """Open a compressed PLY; see `Format.reader`. Raises `FormatError` if it breaks the format, or is another kind of PLY."""
    with open(path, "rb") as file:
        head = file.read(8)
        file.seek(0)
        if not head.startswith(b"ply"):
            raise FormatError(f"{name}: not a compressed PLY: expected 'ply' at byte 0, found {head!r}")
        header = read_header(name, file)
        elements = _checked(header)
        size = file.seek(0, os.SEEK_END)
        ends = header.data_offset + sum(element.count * element.row_size for element in header.elements)
        header.check_size(min(size, ends))
        rows, at = {}, header.data_offset
        for element in header.elements:
            if element.name in elements:
                file.seek(at)
                rows[element.name] = np.fromfile(file, header.dtype(element), element.count)
            at += element.count * element.row_size
    ranges = {
        field: (_columns(rows["chunk"], low), _columns(rows["chunk"], high))
        for field, (low, high) in _RANGES.items()
        if low[0] in (rows["chunk"].dtype.names or ())
    }
    words = {name: np.ascontiguousarray(rows["vertex"][name], np.uint32) for name in _VERTEX}
    sh = np.zeros((header.vertex.count, 0), np.uint8)
    if "sh" in rows:
        names = elements["sh"]
        places = [names.index(f"f_rest_{i}") for i in range(len(names))]
        sh = rows["sh"].view(np.uint8).reshape(-1, len(names))[:, places]
    source = CompressedPlySource(name, ranges, words, sh)
    notes = left_out([element for element in header.elements if element.name not in elements])
    if size > ends:
        notes.append(f"{size - ends} bytes behind the data ignored")
    source.notes = tuple(notes)
    return source


def _checked(header: PlyHeader) -> dict[str, list[str]]:
    """Names of the properties by element that is read; raises `FormatError` if the header is of another kind."""
    name, by_name = header.name, {element.name: element for element in header.elements}
    vertex = {p.name: p for p in header.vertex.properties}
    if "packed_position" not in vertex:
        raise FormatError(
            f"{name}: not a compressed PLY: element 'vertex' lacks 'packed_position'; rename an INRIA PLY so that it ends "
            "in .ply alone"
        )
    if not header.order:
        raise FormatError(f"{name}: a compressed PLY is binary; found format ascii")
    lists = [element.name for element in header.elements if not element.scalar]
    if lists:
        raise FormatError(f"{name}: element {lists[0]!r} has lists, which compressed PLY files do not have")
    for element in header.elements:
        if element.count and not element.properties:
            raise FormatError(f"{name}: element {element.name!r} has {element.count} rows without properties")
    if "chunk" not in by_name:
        raise FormatError(f"{name}: no element 'chunk'; found {', '.join(by_name)}")
    places = [low + high for low, high in _RANGES.values()]
    coloured = any(p.name in places[2] for p in by_name["chunk"].properties)
    _need(name, by_name["chunk"], sum(places[: 3 if coloured else 2], ()), "f")
    _need(name, by_name["vertex"], _VERTEX, "u4")
    count, chunks = header.vertex.count, by_name["chunk"].count
    if chunks != -(-count // CHUNK):
        raise FormatError(
            f"{name}: element 'chunk': expected {-(-count // CHUNK)} rows for {count} vertices, found {chunks}"
        )
    found: dict[str, list[str]] = {"chunk": [], "vertex": []}
    if "sh" in by_name:
        properties = [p.name for p in by_name["sh"].properties]
        if not properties or len(properties) not in REST_WIDTHS:
            raise FormatError(f"{name}: element 'sh': expected 9, 24 or 45 properties, found {len(properties)}")
        _need(name, by_name["sh"], tuple(f"f_rest_{i}" for i in range(len(properties))), "u1")
        if by_name["sh"].count != count:
            raise FormatError(f"{name}: element 'sh': expected {count} rows, found {by_name['sh'].count}")
        found["sh"] = properties
    return found


def _need(name: str, element: Element, names: tuple[str, ...], kind: str) -> None:
    found = {p.name: p.type for p in element.properties}
    words = {"f": "float", "u4": "uint", "u1": "uchar"}[kind]
    for each in names:
        if not found.get(each, "missing").startswith(kind):
            raise FormatError(
                f"{name}: element {element.name!r}: expected property {each!r} of type {words}, found "
                f"{found.get(each, 'none')}"
            )


def _columns(rows: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """[n, names] f64."""
    with np.errstate(invalid="ignore"):  # NaN of the kind that signals
        return np.stack([rows[name].astype(np.float64) for name in names], axis=1)


def write_compressed_ply(file: BinaryIO, source: SceneSource, writing: Writing) -> None:
    """Write a scene as a compressed PLY with ranges of colours; see `Format.writer`."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment {PROGRAM}",
        f"element chunk {-(-source.count // CHUNK)}",
    ]
    lines += [f"property float {name}" for low, high in _RANGES.values() for name in (*low, *high)]
    lines += [f"element vertex {source.count}", *(f"property uint {name}" for name in _VERTEX)]
    if source.sh_degree:
        lines += [f"element sh {source.count}", *(f"property uchar f_rest_{i}" for i in range(source.width("sh_rest")))]
    file.write("\n".join([*lines, "end_header", ""]).encode("ascii"))
    for values in _bounded(source):
        file.write(np.concatenate([end for field in _RANGES for end in _ends(values[field])], axis=1).tobytes())
    for values in _bounded(source):
        file.write(_vertices(values).tobytes())
    for rows in source.chunks(_CHUNK_ROWS) if source.sh_degree else ():
        file.write(_sh_codes(source.read(rows, ["sh_rest"])["sh_rest"]).T.tobytes())


def chunk_order(means: np.ndarray) -> np.ndarray:
    """[n] i64, an order of rows whose chunks take little room: a chunk rounds positions to shares of its range.

    Boxes are cut in two until they are chunks, each where the squares of the ranges of all rows then add up to the least.
    """
    places = means.astype(np.float64) * np.array([[1.0], [2.0], [1.0]])  # y has a bit less
    chunks, waiting = list[np.ndarray](), [np.argsort(places, axis=1, kind="stable")]
    side = np.zeros(means.shape[1], bool)
    while waiting:
        sorted_rows = waiting.pop()
        count = sorted_rows.shape[1]
        if count <= CHUNK:
            chunks.append(sorted_rows[0])
            continue
        starts = np.arange(0, count, CHUNK)
        costs = np.full((3, len(starts) - 1), np.inf)
        if len(starts) > _CUT_CHUNKS:
            ends = [places[axis, sorted_rows[axis, [0, -1]]] for axis in range(3)]
            costs[np.argmax([high - low for low, high in ends]), len(starts) // 2 - 1] = 0.0
        else:
            for axis, rows in enumerate(sorted_rows):
                low, high = (each.reduceat(places[:, rows], starts, axis=1) for each in (np.minimum, np.maximum))
                before = np.maximum.accumulate(high, axis=1) - np.minimum.accumulate(low, axis=1)
                after = np.maximum.accumulate(high[:, ::-1], axis=1) - np.minimum.accumulate(low[:, ::-1], axis=1)
                left, right = (np.square(ranges).sum(axis=0) for ranges in (before[:, :-1], after[:, -2::-1]))
                costs[axis] = left * starts[1:] + right * (count - starts[1:])
        axis, cut = divmod(int(np.argmin(costs)), costs.shape[1])
        side[sorted_rows[axis]] = np.arange(count) < starts[1 + cut]
        first = side[sorted_rows]
        waiting += [sorted_rows[~first].reshape(3, -1), sorted_rows[first].reshape(3, -1)]
    # Only the last chunk of a file may have fewer rows.
    return np.concatenate(sorted(chunks, key=lambda rows: len(rows) != CHUNK))


def _bounded(source: SceneSource) -> Iterator[Planes]:
    """Planes of whole chunks, with scales within limits and colours in place of coefficients."""
    for rows in source.chunks(_CHUNK_ROWS):
        planes = source.read(rows, ["means", "quats", "log_scales", "sh_dc", "opacity_logits"])
        planes["log_scales"] = np.clip(planes["log_scales"], -_SCALE_LIMIT, _SCALE_LIMIT)
        planes["sh_dc"] = (planes["sh_dc"] * np.float64(SH_C0) + 0.5).astype(np.float32)
        yield planes


def _ends(plane: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest values of every chunk, [chunks, 3] little-endian float32 each."""
    starts = np.arange(0, plane.shape[1], CHUNK)
    low, high = (extreme.reduceat(plane, starts, axis=1) for extreme in (np.minimum, np.maximum))
    return low.T.astype("<f4"), high.T.astype("<f4")


def _vertices(planes: Planes) -> np.ndarray:
    """[n, 4] u32, the words of every Gaussian."""
    shares = {}
    for field in _RANGES:
        low, high = (
            np.repeat(end, CHUNK, axis=0)[: planes[field].shape[1]].T.astype(np.float64) for end in _ends(planes[field])
        )
        width = high - low
        shares[field] = (planes[field] - low) / np.where(width > 0, width, 1)
    opaque = opacities(planes["opacity_logits"][0])
    places, scales = (
        sum(_code(share, width) << np.uint32(at) for share, (at, width) in zip(shares[field], _BITS, strict=True))
        for field in ("means", "log_scales")
    )
    colours = [_code(share, 8) for share in (*shares["sh_dc"], opaque)]
    colour = colours[0] << 24 | colours[1] << 16 | colours[2] << 8 | colours[3]
    return np.stack([places, _quat_words(planes["quats"]), scales, colour], axis=1).astype("<u4")


def _code(shares: np.ndarray, bits: int) -> np.ndarray:
    """[n] u32, the nearest of 2^bits codes for 0 to 1."""
    most = (1 << bits) - 1
    return nearest(shares * most, most).astype(np.uint32)


def _quat_words(quats: np.ndarray) -> np.ndarray:
    largest, others = without_largest(quats)
    first, second, third = (_code(part / np.sqrt(2) + 0.5, 10) for part in others)
    return largest.astype(np.uint32) << 30 | first << 20 | second << 10 | third


def _sh_codes(values: np.ndarray) -> np.ndarray:
    """u8, the code whose value is the nearest."""
    places = (values.astype(np.float64) / (2 * _SH_REACH) + 0.5) * 256
    # The outermost codes stand for the ends of their intervals, so that they are the nearest for half as far.
    return np.where(places < 0.75, 0, np.where(places > 255.25, 255, np.clip(np.floor(places), 1, 254))).astype(
        np.uint8
    )
