"""The fitted model of a file, stored in its model section: predictions, contexts and frequency tables for all chunks."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from flexgs_edge.codec.v2 import octree
from flexgs_edge.codec.v2.groups import Group, GroupKind
from flexgs_edge.codec.v2.rans import Tables
from flexgs_edge.codec.v2.tables import decode_tables, encode_tables, from_levels
from flexgs_edge.codec.v2.walk import base_kinds, sh_kinds
from flexgs_edge.constants import RANS_PRECISION as PRECISION

REPEATS_MOST = 16  # Symbols of the alphabet of repeats; the last one is the escape
SHARED = 2  # Alphabets that come before those of the groups: the octree's and that of the repeats


@dataclass(frozen=True, eq=False)
class Model:
    """Everything that a decoder needs besides the stream of a chunk.

    `sh_degree`, `depth`: SH degree of the scene, and depth of its octree.
    """

    sh_degree: int
    depth: int
    groups: list[Group]  # base channels, then SH
    # For each alphabet, [contexts] u8, the table of every context; alphabets are the octree, the repeats, the groups.
    mappings: list[np.ndarray]
    levels: list[np.ndarray]  # for each alphabet, [tables, symbols] u8, the frequencies as the file stores them
    tables: list[Tables]  # for each alphabet, its frequency tables

    @cached_property
    def slots(self) -> list[np.ndarray]:
        """For each alphabet, the first slot of every context's table, as `Decoder.get_at` takes it."""
        return [mapping.astype(np.intp) << PRECISION for mapping in self.mappings]

    def to_bytes(self, with_sh: bool = True) -> bytes:
        """The model section of a file; `with_sh=False` only serves to compare sizes."""
        chosen = [i for i, group in enumerate(self.groups) if with_sh or not group.kind.sh]
        records = b"".join(self.groups[i].to_bytes() for i in chosen)
        alphabets = [0, 1, *(i + SHARED for i in chosen)]
        return records + encode_tables([self.mappings[i] for i in alphabets], [self.levels[i] for i in alphabets])

    @classmethod
    def from_bytes(cls, data: bytes, sh_degree: int, depth: int) -> Model:
        """Inverse of `to_bytes`; raises `StreamError` for a damaged model."""
        groups, at = [], 0
        for kind in group_kinds(sh_degree):
            group, at = Group.read(kind, data, at)
            groups.append(group)
        shapes = [(octree.CONTEXTS, 256), (1, REPEATS_MOST), *((g.contexts, g.symbols) for g in groups)]
        pairs = decode_tables(data[at:], shapes)
        levels = [level for _, level in pairs]
        return cls(sh_degree, depth, groups, [mapping for mapping, _ in pairs], levels, list(map(tables_of, levels)))


def group_kinds(sh_degree: int) -> list[GroupKind]:
    """All groups of a scene with this SH degree."""
    return base_kinds() + sh_kinds(sh_degree)


def tables_of(levels: np.ndarray) -> Tables:
    """Tables of an alphabet. If no symbol was counted, the first symbol gets all the frequency and costs nothing."""
    if not levels.any(axis=1).all():
        levels = levels.copy()
        levels[~levels.any(axis=1), 0] = 1
    return from_levels(levels)
