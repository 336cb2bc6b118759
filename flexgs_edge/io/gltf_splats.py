"""Gaussians of a glTF's primitives in memory, as accessors or as a `.spz`, and all of them as one scene."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.io.decoded import DecodedSource, opacity_logits
from flexgs_edge.io.gltf_container import Packed
from flexgs_edge.io.gltf_nodes import Move
from flexgs_edge.io.ply import choose_origin, origin_rows
from flexgs_edge.scene.fields import FIELD, sh_rest_count
from flexgs_edge.scene.source import Rows, SceneSource, by_chunk


class Splats(Protocol):
    """Gaussians of a primitive, as the mesh has them."""

    count: int
    sh_degree: int

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """[width, n] f64."""


@dataclass
class AttributeSplats:
    """Gaussians whose values are accessors."""

    count: int
    sh_degree: int
    means: Packed
    quats: Packed
    scales: Packed
    opacities: Packed
    dc: Packed
    rest: list[Packed]
    has_colours: bool  # `dc` holds colours, not SH
    as_logs: bool = False  # `scales` holds logarithms

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """See `Splats`."""
        if field == "means":
            return self.means.read(rows)
        if field == "quats":
            return self.quats.read(rows)[[3, 0, 1, 2]]
        if field == "log_scales":
            scales = self.scales.read(rows)
            with np.errstate(divide="ignore", invalid="ignore"):
                return scales if self.as_logs else np.log(scales)
        if field == "opacity_logits":
            return opacity_logits(self.opacities.read(rows)[-1:], np.inf)  # check_scene clamps what is infinite
        if field == "sh_dc":
            dc = self.dc.read(rows)[:3]
            return (dc - 0.5) / SH_C0 if self.has_colours else dc
        planes = np.stack([packed.read(rows) for packed in self.rest], axis=1)
        return planes.reshape(3 * len(self.rest), -1)


class SpzSplats:
    """Gaussians of a `.spz`."""

    def __init__(self, source: SceneSource) -> None:
        self.source, self.count, self.sh_degree = source, source.count, source.sh_degree

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """See `Splats`."""
        return self.source.read(rows, [field])[field].astype(np.float64)


class GltfSource(DecodedSource):
    """The splats of a glTF, one after the other.

    `name`: the user's path, for messages. `parts`: Gaussians, and where they are shown. `held_bytes`: bytes of their
    packed values.
    """

    def __init__(self, name: str, parts: Sequence[tuple[Splats, Move]], held_bytes: int) -> None:
        counts = [splats.count for splats, _ in parts]
        degree = max((splats.sh_degree for splats, _ in parts), default=0)
        super().__init__(name, sum(counts), degree, held_bytes)
        self._parts = parts
        self._starts = np.cumsum([0, *counts[:-1]])
        sample = self.decode(origin_rows(self.count), "means") if self.count else np.zeros((3, 0))
        self.origin = choose_origin(sample.T)

    def decode(self, rows: Rows, field: str) -> np.ndarray:
        """See `DecodedSource.decode`."""
        size = rows.stop - rows.start if isinstance(rows, slice) else len(rows)
        values = np.zeros((FIELD[field].width(self.sh_degree), size))
        for number, chosen, place in by_chunk(rows, self._starts):
            (splats, move), start = self._parts[number], int(self._starts[number])
            own: Rows = (
                slice(chosen.start - start, chosen.stop - start) if isinstance(chosen, slice) else chosen - start
            )
            if field == "sh_rest" and not splats.sh_degree:
                continue
            found = move.apply(field, partial(splats.decode, own))
            if field == "sh_rest":
                count = sh_rest_count(splats.sh_degree)
                values.reshape(3, -1, size)[:, :count, place] = found.reshape(3, count, -1)
                continue
            if field == "means":
                with np.errstate(over="ignore", invalid="ignore"):
                    found = found + (move.offset - self.origin)[:, None]
            values[:, place] = found
        return values
