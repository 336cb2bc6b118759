"""A second decoder of `.fgs` files of version 2 that follows docs/format.md and shares no code with the package.

Written to be read: single symbols, rows and neighbours in plain Python; NumPy only for float32's roundings.
"""

from __future__ import annotations

import json
import math
import struct
import zlib
from dataclasses import dataclass
from typing import Any

import numpy as np

from educational_decoder import expanded

f32 = np.float32
SCALES = ["scale x", "scale y", "scale z"]
LISTED: dict[str, list[str]] = {
    "scale x": [],
    "scale y": SCALES[:1],
    "scale z": SCALES[:2],
    "opacity": SCALES,
    "dc Y": ["opacity", *SCALES],
    "dc Co": ["dc Y", "opacity"],
    "dc Cg": ["dc Y", "dc Co"],
    "sh degree": ["opacity", "dc Y", "dc Co", "dc Cg"],
    "rotation x": SCALES,
    "rotation y": SCALES,
    "rotation z": SCALES,
}
BASE = list(LISTED)
Table = list[int]  # frequencies


# Streams


class Stream:
    def __init__(self, data: bytes, lanes: int) -> None:
        self.states = list(struct.unpack_from(f"<{lanes}I", data))
        self.words = struct.unpack_from(f"<{(len(data) - 4 * lanes) // 2}H", data, 4 * lanes)
        self.used = 0

    def batch(self, tables: list[Table]) -> list[int]:
        """One symbol for each of the tables given."""
        symbols = []
        for i, freqs in enumerate(tables):
            lane = i % len(self.states)
            x = self.states[lane]
            symbol, start = 0, 0
            while start + freqs[symbol] <= x % 2**14:
                start += freqs[symbol]
                symbol += 1
            x = freqs[symbol] * (x // 2**14) + x % 2**14 - start
            if x < 2**16:
                x = 2**16 * x + self.words[self.used]
                self.used += 1
            self.states[lane] = x
            symbols.append(symbol)
        return symbols

    def raw(self, bits: int, count: int) -> list[int]:
        values = [0] * count
        for at in range(0, bits, 8):
            size = min(bits - at, 8)
            part = self.batch([[2**14 >> size] * 2**size] * count)
            values = [value + (more << at) for value, more in zip(values, part, strict=True)]
        return values

    def end(self) -> None:
        assert self.states == [2**16] * len(self.states) and not any(self.words[self.used :])


# Model


@dataclass
class Group:
    centre: int
    shift: int
    low: int
    symbols: int
    weights: list[list[int]]  # of P, of E
    cuts: list[list[int]]
    residual: bool
    contexts: int
    tables: list[Table]  # of every context


def frequencies(levels: list[int]) -> Table:
    weights = [0 if v == 0 else (4 + (v - 1) % 4) * 2 ** ((v - 1) // 4) for v in levels]
    if not any(weights):
        return [2**14] + [0] * (len(levels) - 1)
    freqs = [max(1, 2**14 * weight // sum(weights)) if weight else 0 for weight in weights]
    order = sorted((i for i, f in enumerate(freqs) if f), key=lambda i: -freqs[i])
    while sum(freqs) != 2**14:
        missing = 2**14 - sum(freqs)
        chosen = order if missing > 0 else [i for i in order if freqs[i] > 1]
        for i in chosen[: abs(missing)]:
            freqs[i] += 1 if missing > 0 else -1
    return freqs


def read_model(data: bytes, degree: int) -> tuple[list[Table], list[Table], list[Group]]:
    """Tables of the octree's contexts, of the repeats, and the groups."""
    kinds = [(3 + 3 * len(LISTED[name]), name.startswith(("scale", "opacity", "dc"))) for name in BASE]
    kinds += [(9 + 3 * plane, False) for _ in range(degree) for plane in range(3)]
    groups, at = [], 0
    for features, residual in kinds:
        centre, shift, low, symbols, *lengths, weighted = struct.unpack_from("<iBiHBBB", data, at)
        at += struct.calcsize("<iBiHBBB")
        weights = [[0] * (features + 1), [0] * (features + 1)]
        for row in weights if weighted else []:
            row[:] = struct.unpack_from(f"<{features + 1}h", data, at)
            at += 2 * (features + 1)
        cuts = []
        for length in lengths:
            cuts.append(list(struct.unpack_from(f"<{length}i", data, at)))
            at += 4 * length
        contexts = (2 if residual else lengths[0] + 1) * (lengths[1] + 1)
        groups.append(Group(centre, shift, low, symbols, weights, cuts, residual, contexts, []))
    classes = []
    for _ in range(5):
        n = data[at]
        levels = list(data[at + 1 : at + 1 + n]) + [0] * (65 - n)
        classes.append(frequencies(levels if n else [1] * 65))
        at += 1 + n
    stream = Stream(data[at:], 16)

    def read_tables(contexts: int, size: int) -> list[Table]:
        mapping = stream.batch([classes[4]] * contexts)
        rows: list[list[int]] = []
        for t in range(max(mapping) + 1):
            if t == 0:
                row, total = [], 0
                for difference in stream.batch([classes[0]] * size):
                    total = (total + difference) % 65
                    row.append(total)
            else:
                above = rows[-1]
                kind = [1 if v == 0 else 3 if v > 20 else 2 for v in above]
                row = [(v + d) % 65 for v, d in zip(above, stream.batch([classes[k] for k in kind]), strict=True)]
            rows.append(row)
        return [frequencies(rows[t]) for t in mapping]

    octree, repeats = read_tables(30, 256), read_tables(1, 16)
    for group in groups:
        group.tables = read_tables(group.contexts, group.symbols)
    stream.end()
    return octree, repeats, groups


# Streams: octree and repeats


def read_cells(stream: Stream, octree: list[Table], repeats: list[Table], depth: int) -> list[tuple[int, int, int]]:
    nodes = [(0, 0, 0, 0)]  # x, y, z, children of the parent
    for level in range(depth - 1, -1, -1):
        tables = [octree[min(level, 5) * 5 + min(parent, 4)] for _, _, _, parent in nodes]
        children = []
        for (x, y, z, _), byte in zip(nodes, stream.batch(tables), strict=True):
            for c in range(8):
                if byte >> c & 1:
                    children.append((2 * x + (c >> 2), 2 * y + (c >> 1 & 1), 2 * z + (c & 1), byte.bit_count()))
        nodes = children
    again = stream.batch(repeats * len(nodes))
    raw = iter(stream.raw(32, again.count(15)))
    times = [1 + (next(raw) if symbol == 15 else symbol) for symbol in again]
    return [node[:3] for node, count in zip(nodes, times, strict=True) for _ in range(count)]


# Passes


def passes(n: int) -> list[tuple[list[int], int]]:
    """Rows of each pass, and the distance from them to their nearest neighbours in row order (0 in the first)."""
    top = ((n - 1) // 256).bit_length()
    result = [(list(range(0, n, 2**top)), 0)]
    for k in range(top - 1, -1, -1):
        result.append((list(range(2**k, n, 2 * 2**k)), 2**k))
    return result


def neighbours(row: int, near: int, q: int, n: int) -> list[int]:
    last = (n - 1) // (2 * near) * 2 * near
    return [min(max(row + near * (2 * i + 1), 0), last) for i in range(-q, q)]


def own_features(row: int, near: int, q: int, cells: list[tuple[int, int, int]], values: list[int]) -> list[int]:
    """m, spread, near."""
    if near == 0:
        return [0, 0, 0]
    rows = neighbours(row, near, q, len(cells))
    squares = []
    for other in rows:
        d = f32(0)
        for axis in range(3):
            away = f32(cells[other][axis]) - f32(cells[row][axis])
            d = d + away * away
        squares.append(d)
    shares = [f32(1) / (d + f32(1)) for d in squares]
    total = shares[0]
    for share in shares[1:]:
        total = total + share
    factor = f32(256) / total
    weights = [int(np.rint(share * factor)) for share in shares]
    m = sum(w * values[other] for w, other in zip(weights, rows, strict=True))
    middle = (m + 128) // 256
    spread = sum(w * abs(values[other] - middle) for w, other in zip(weights, rows, strict=True))
    return [m, spread, 256 * math.frexp(min(squares) + f32(1))[1]]


# Prediction


def limit(code: int) -> int:
    return min(max(code, -16383), 16383)


def read_channel(
    stream: Stream, group: Group, cells: list[tuple[int, int, int]], q: int, others: list[list[int]]
) -> tuple[list[int], list[int]]:
    """Codes of all rows, and each row's m (its value in the first pass); `others`: features of every row."""
    n = len(cells)
    codes, values, means = [0] * n, [0] * n, [0] * n
    for rows, near in passes(n) if n else []:
        tables, bases = [], []
        for row in rows:
            own = own_features(row, near, q, cells, values)
            means[row] = own[0]
            features = [*own, *others[row], 256]
            p, e = (sum(w * f for w, f in zip(line, features, strict=True)) for line in group.weights)
            b = sum(cut <= e // 1024 for cut in group.cuts[1])
            if group.residual:
                whole = (p + 32768) // 65536
                a, r = int(p >= 65536 * whole), whole + group.centre
            else:
                a, r = sum(cut <= p // 4096 for cut in group.cuts[0]), 0
            tables.append(group.tables[a * (len(group.cuts[1]) + 1) + b])
            bases.append(r + group.low)
        symbols = stream.batch(tables)
        escape = group.symbols - 1
        raw = iter(stream.raw(group.shift, sum(symbol != escape for symbol in symbols)))
        far = iter(stream.raw(32, symbols.count(escape)))
        for row, base, symbol in zip(rows, bases, symbols, strict=True):
            if symbol == escape:
                number = next(far)
                codes[row] = base + (number - 2**32 if number >= 2**31 else number)
            else:
                codes[row] = base + symbol * 2**group.shift + next(raw)
        for row in rows:
            values[row] = limit(codes[row])
            if near == 0:
                means[row] = 256 * values[row]
    return codes, means


def read_chunk(
    data: bytes, rows: int, model: tuple[list[Table], list[Table], list[Group]], depth: int, degree: int
) -> tuple[list[tuple[int, int, int]], dict[str, list[int]], dict[tuple[int, int, int], list[int]]]:
    """Cells; codes of the base channels; codes of (degree, coefficient, plane) for all rows, 0 where a row has none."""
    octree, repeats, groups = model
    lanes = 1
    while lanes < 512 and 2 * lanes <= rows / 128:
        lanes *= 2
    stream = Stream(data, lanes)
    cells = read_cells(stream, octree, repeats, depth)
    assert len(cells) == rows
    base: dict[str, list[int]] = {}
    triples: dict[str, list[list[int]]] = {}
    for name, group in zip(BASE, groups[:11], strict=True):
        if name == "sh degree" and degree == 0:
            base[name] = [0] * rows
            continue
        others = [[number for e in LISTED[name] for number in triples[e][row]] for row in range(rows)]
        base[name], means = read_channel(stream, group, cells, 4, others)
        scaled = [256 * limit(code) for code in base[name]]
        triples[name] = [[v, m, abs(v - m)] for v, m in zip(scaled, means, strict=True)]
    sh: dict[tuple[int, int, int], list[int]] = {}
    below = [[0] * rows for _ in range(3)]
    for level in range(1, degree + 1):
        has = [row for row in range(rows) if base["sh degree"][row] >= level]
        there = [cells[row] for row in has]
        sums = [[0] * rows for _ in range(3)]
        for k in range(2 * level + 1):
            known: list[list[int]] = []
            for plane in range(3):
                others = []
                for row in has:
                    line = [sums[plane][row], below[plane][row]]
                    line += [triples[name][row][0] for name in ("opacity", *SCALES)]
                    for values in known:
                        line += [values[row], abs(values[row])]
                    line += [sums[earlier][row] for earlier in range(plane)]
                    others.append(line)
                codes, _ = read_channel(stream, groups[11 + 3 * (level - 1) + plane], there, 2, others)
                sh[level, k, plane] = [0] * rows
                known.append([0] * rows)
                for row, code in zip(has, codes, strict=True):
                    sh[level, k, plane][row] = code
                    known[plane][row] = 256 * limit(code)
            for plane in range(3):
                sums[plane] = [s + abs(v) for s, v in zip(sums[plane], known[plane], strict=True)]
        below = [[min(number, 256 * 16383) for number in row] for row in sums]
    stream.end()
    return cells, base, sh


# Values


def colour(y: int, co: int, cg: int, step: float, chroma: float) -> list[f32]:
    wide = f32(step) * f32(chroma)
    h, c = f32(cg) * wide * f32(0.5), f32(co) * wide * f32(0.5)
    luma = f32(y) * f32(step)
    return [luma - h + c, luma + h, luma - h - c]


def decode(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The header and {array: [C, N] f32}."""
    # Preamble and header
    magic, version, must, _may, size, header_length, header_crc, crc = struct.unpack("<8sHHIQIII", data[:36])
    assert magic == bytes.fromhex("934647530D0A1A0A") and version == 2 and must == 0
    assert size == len(data) and crc == zlib.crc32(data[:32])
    text = data[36 : 36 + header_length]
    assert header_crc == zlib.crc32(text)
    header = json.loads(text)
    degree, steps = header["sh_degree"], header["steps"]

    # Model
    at = 36 + header_length
    model_data = data[at : at + header["model_bytes"]]
    at += header["model_bytes"]
    assert struct.unpack_from("<I", data, at)[0] == zlib.crc32(model_data)
    at += 4
    model = read_model(model_data, degree)

    # Preview
    preview = header.get("preview_bytes", 0)
    if preview:
        small, _ = decode(data[at : at + preview])
        assert "preview_bytes" not in small and small["origin"] == header["origin"]
        assert small["sh_degree"] in (0, degree)
    at += preview

    # Chunks and chunk table
    lengths = []
    for layer in header["layers"]:
        for start in range(0, layer, header["chunk_rows"]):
            lengths.append(min(header["chunk_rows"], layer - start))
    table = len(data) - 8 * len(lengths) - 4
    assert struct.unpack_from("<I", data, len(data) - 4)[0] == zlib.crc32(data[table:-4])
    columns: list[list[f32]] = []
    for i, rows in enumerate(lengths):
        length, crc = struct.unpack_from("<II", data, table + 8 * i)
        chunk = data[at : at + length]
        assert crc == zlib.crc32(chunk)
        at += length
        cells, base, sh = read_chunk(chunk, rows, model, header["depth"], degree)
        for row in range(rows):
            column = [
                f32(low + cell) * f32(steps["position"]) for low, cell in zip(header["low"], cells[row], strict=True)
            ]
            codes = {name: base[name][row] for name in BASE}
            column += colour(codes["dc Y"], codes["dc Co"], codes["dc Cg"], steps["dc"], steps["chroma"])
            rest = [
                colour(*(sh[level, k, plane][row] for plane in range(3)), steps["sh"][level - 1], steps["chroma"])
                for level in range(1, degree + 1)
                for k in range(2 * level + 1)
            ]
            column += [value[channel] for channel in range(3) for value in rest]
            column.append(f32(codes["opacity"]) * f32(steps["opacity"]))
            column += [f32(codes[name]) * f32(steps["scale"]) for name in SCALES]
            x, y, z = (f32(codes[f"rotation {axis}"]) * f32(steps["rotation"]) for axis in "xyz")
            column += [np.sqrt(max(f32(0), f32(1) - ((x * x + y * y) + z * z))), x, y, z]
            columns.append(column)
    assert at == table
    if "contraction" in steps:
        means = expanded(np.array([column[:3] for column in columns], f32).T, steps["contraction"])
        columns = [[*place, *column[3:]] for place, column in zip(means.T, columns, strict=True)]
    widths = {
        "means": 3,
        "sh_dc": 3,
        "sh_rest": 3 * ((degree + 1) ** 2 - 1),
        "opacity_logits": 1,
        "log_scales": 3,
        "quats": 4,
    }
    planes = np.array(columns, f32).reshape(len(columns), sum(widths.values())).T
    cuts = np.cumsum(list(widths.values()))[:-1]
    return header, dict(zip(widths, np.split(planes, cuts), strict=True))
