"""Write streamed SOG scenes of PlayCanvas: `lod-meta.json`, and a folder of pictures for each part of each level.

A level stands for the whole scene, so each is written whole: the finest has all layers of a `.fgs`, the next all but the last,
and so on, with larger Gaussians (`growth`); the coarsest is the preview. Viewers load a coarse level first, and finer ones where
somebody looks.
"""

import io
import json
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge._version import __version__
from flexgs_edge.io.reading import Writing
from flexgs_edge.io.sog import META
from flexgs_edge.io.sog_writer import write_sog
from flexgs_edge.scene.curve import near_rows
from flexgs_edge.scene.rotations import matrices
from flexgs_edge.scene.source import GrownSource, SceneSource

STREAMED = "lod-meta.json"
LEAF_ROWS = 1 << 19  # Most Gaussians of a part at the finest level. Smaller parts pay for more palettes.
_REACH = 3.0  # Standard deviations within which a Gaussian counts for the box of its part
_CHUNK_ROWS = 65536


def level_counts(layers: Sequence[int]) -> list[int]:
    """Gaussians of each level, the finest first, from the Gaussians that each layer adds.

    >>> level_counts([5, 0, 10, 20]), level_counts([0, 3])
    ([35, 15, 5], [3])
    """
    sums = np.cumsum(np.asarray(layers, np.int64))
    return sorted({int(count) for count in sums if count}, reverse=True)


def write_streamed_sog(
    folder: Path, source: SceneSource, layers: Sequence[int], writing: Writing, preview: SceneSource | None = None
) -> None:
    """Write the scene into an empty folder.

    `source`: world positions, as `write_sog` takes it; the rows of earlier layers first. `layers`: Gaussians of each
    layer. `preview`: the scene in far fewer Gaussians, as a level of its own.
    """
    writer = _Writer(folder, source, level_counts(layers), writing, preview)
    tree = writer.node(np.arange(source.count), np.arange(writer.preview_means.shape[1]))
    counts = writer.counts + ([] if preview is None else [preview.count])
    meta = {
        "version": 1,
        "asset": {"generator": f"flexgs-edge {__version__}"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(counts),
        "filenames": writer.files,
        "tree": tree,
    }
    (folder / STREAMED).write_text(json.dumps(meta, separators=(",", ":"), allow_nan=False))


class _Writer:
    """Writes the nodes of the tree, and the folders of its leaves."""

    def __init__(
        self, folder: Path, source: SceneSource, counts: list[int], writing: Writing, preview: SceneSource | None
    ) -> None:
        self.folder, self.source, self.counts, self.writing, self.preview = folder, source, counts, writing, preview
        self.means = _means(source)
        self.preview_means = np.zeros((3, 0), np.float32) if preview is None else _means(preview)
        self.files: list[str] = []
        self.leaves = 0

    def node(self, rows: np.ndarray, previewed: np.ndarray) -> dict[str, Any]:
        """Halves along the widest axis, or the levels of these rows and rows of the preview, which ascend."""
        if len(rows) <= LEAF_ROWS:
            return {"bound": self._bound(rows, previewed), "lods": self._levels(rows, previewed)}
        here = self.means[:, rows]
        axis = int(np.ptp(here, axis=1).argmax())
        halves = np.array_split(rows[np.argsort(here[axis], kind="stable")], 2)
        below = self.preview_means[axis, previewed] < self.means[axis, halves[1][0]]
        children = [
            self.node(np.sort(half), previewed[some]) for half, some in zip(halves, (below, ~below), strict=True)
        ]
        lows, highs = ([child["bound"][end] for child in children] for end in ("min", "max"))
        bound = {"min": np.min(lows, axis=0).tolist(), "max": np.max(highs, axis=0).tolist()}
        return {"bound": bound, "children": children}

    def _levels(self, rows: np.ndarray, previewed: np.ndarray) -> dict[str, Any]:
        levels: dict[str, Any] = {}
        for level, count in enumerate(self.counts):
            some = rows[: np.searchsorted(rows, count)]
            if not some.size:
                break  # coarser levels have even fewer
            name = f"{level}_{self.leaves}"
            part = self.source.select(some[near_rows(self.means[:, some])])
            self._write(name, GrownSource(part, len(rows)) if level else part)
            levels[str(level)] = {"file": len(self.files) - 1, "offset": 0, "count": len(some)}
        if self.preview is not None and previewed.size:
            level = len(self.counts)
            order = near_rows(self.preview_means[:, previewed])
            self._write(f"{level}_{self.leaves}", self.preview.select(previewed[order]))
            levels[str(level)] = {"file": len(self.files) - 1, "offset": 0, "count": len(previewed)}
        self.leaves += 1
        return levels

    def _write(self, name: str, source: SceneSource) -> None:
        file = io.BytesIO()
        write_sog(file, source, self.writing)
        with zipfile.ZipFile(file) as archive:
            archive.extractall(self.folder / name)
        self.files.append(f"{name}/{META}")

    def _bound(self, rows: np.ndarray, previewed: np.ndarray) -> dict[str, list[float]]:
        """The box around the Gaussians of these rows, with the digits of float32."""
        low, high = _box(self.source, rows)
        if self.preview is not None and previewed.size:
            others = _box(self.preview, previewed)
            low, high = np.minimum(low, others[0]), np.maximum(high, others[1])
        return {name: [float(f"{value:.7g}") for value in end] for name, end in (("min", low), ("max", high))}


def _means(source: SceneSource) -> np.ndarray:
    return np.concatenate([source.read(rows, ["means"])["means"] for rows in source.chunks(_CHUNK_ROWS)], axis=1)


def _box(source: SceneSource, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest corner of the box around the Gaussians of these rows."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for start in range(0, len(rows), _CHUNK_ROWS):
        planes = source.read(rows[start : start + _CHUNK_ROWS], ["means", "log_scales", "quats"])
        scales = np.exp(planes["log_scales"].T.astype(np.float64))
        reach = _REACH * np.sqrt(np.square(matrices(planes["quats"]) * scales[:, None]).sum(axis=2)).T
        low = np.minimum(low, (planes["means"] - reach).min(axis=1))
        high = np.maximum(high, (planes["means"] + reach).max(axis=1))
    return low, high
