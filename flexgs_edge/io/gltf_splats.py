"""Gaussians of a glTF's primitives in memory, as accessors or as a `.spz`; nodes that show and move them; all as one scene.

Positions are moved by a node's matrix M. A Gaussian's covariance C C^T becomes M C C^T M^T. If M is a rotation and one scale,
its quaternion is turned and its scales are multiplied; otherwise the singular values and vectors of M C are its new scales
and axes, which is the eigen decomposition of the covariance without squaring it. SH are turned by the rotation part of M, its
polar factor, which may be a mirror.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Protocol

import numpy as np

from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import FormatError
from flexgs_edge.io.decoded import PartsSource, opacity_logits
from flexgs_edge.io.gltf_container import Packed
from flexgs_edge.io.json_object import JsonObject
from flexgs_edge.io.ply import choose_origin, origin_rows
from flexgs_edge.scene.rotations import band_matrices, matrices, quats_of, times, turn_sh
from flexgs_edge.scene.source import Rows, SceneSource
from flexgs_edge.small_matrices import product

_SAME = 1e-6  # Largest difference between the scales of axes that count as one: the rounding of float32
_STILL = 1e-12  # Largest difference from the identity that is rounding alone

_MOVES = {"matrix", "rotation", "scale", "translation"}  # Keys of a node that move it

Reader = Callable[[str], np.ndarray]  # Gives the values of a field before they are moved, [width, n] f64


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
        return self.source.read(rows, [field])[field].astype(np.float64)


@dataclass(frozen=True)
class Shown:
    """A mesh that a node shows."""

    mesh: int  # index of the mesh
    node: int  # index of the node
    matrix: np.ndarray  # [4, 4] f64, from the mesh to the world


def shown_meshes(file: JsonObject) -> Iterator[Shown]:
    """All meshes that the default scene shows: the named one, else the first; without scenes, all nodes.

    Raises `FormatError` if nodes do not form trees, or a transform is not finite.
    """
    seen: set[int] = set()
    waiting = [(index, np.eye(4), asker) for index, asker in reversed(_roots(file))]
    while waiting:
        index, parent, asker = waiting.pop()
        node = file.item("nodes", index, asker)
        if index in seen:
            raise FormatError(f"{file.name}: {asker}: {node.place} has two parents; expected a tree of nodes")
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            matrix = parent @ _local_matrix(node) if _MOVES & node.value.keys() else parent
        if not np.isfinite(matrix).all():
            raise FormatError(f"{file.name}: {node.place}: its transform goes beyond float64; expected finite numbers")
        if "mesh" in node:
            yield Shown(node.whole("mesh"), index, matrix)
        waiting += [(child, matrix, node.place) for child in reversed(node.wholes("children"))]


def _roots(file: JsonObject) -> list[tuple[int, str]]:
    scenes, nodes = file.items("scenes"), file.items("nodes")
    if scenes:
        scene = file.item("scenes", file.whole("scene", 0), "scene")
        return [(index, scene.place) for index in scene.wholes("nodes")]
    children = {child for i in range(len(nodes)) for child in file.item("nodes", i, "nodes").wholes("children")}
    return [(index, "nodes") for index in range(len(nodes)) if index not in children]


def _local_matrix(node: JsonObject) -> np.ndarray:
    """[4, 4] f64, from the node to its parent."""
    if "matrix" in node:
        matrix = node.numbers("matrix", 16).reshape(4, 4).T
        matrix[3] = (0, 0, 0, 1)
        return matrix
    matrix = np.eye(4)
    if "rotation" in node:
        x, y, z, w = node.numbers("rotation", 4)
        quat = np.array([w, x, y, z])
        largest = np.abs(quat).max()
        if largest == 0:
            raise node.fail("rotation", "a quaternion that is not zero", quat.tolist())
        matrix[:3, :3] = matrices((quat / largest)[:, None])[0]
    if "scale" in node:
        matrix[:3, :3] *= node.numbers("scale", 3)
    if "translation" in node:
        matrix[:3, 3] = node.numbers("translation", 3)
    return matrix


class Move:
    """What a matrix makes of Gaussians. `matrix`: [4, 4] f64."""

    def __init__(self, matrix: np.ndarray) -> None:
        self.linear, self.offset = matrix[:3, :3], matrix[:3, 3]
        self.size = float(np.abs(self.linear).max())
        left, scales, right = np.linalg.svd(self.linear / (self.size or 1.0))
        turn = left @ right
        self._still = bool(np.array_equal(self.linear, np.eye(3)))
        self._uniform = bool(scales[0] - scales[2] <= _SAME * scales[0])
        # The determinant is the cube of one scale, so that a matrix of few digits keeps its volume.
        self._log_scale = float(np.log(scales).mean() + np.log(self.size)) if self._uniform and self.size else 0.0
        # A Gaussian looks the same when its own axes turn round, so that a mirror turns it as its negative does.
        self._quat = quats_of((turn * np.linalg.det(turn))[None])[:, 0]
        self._bands = [] if np.abs(turn - np.eye(3)).max() < _STILL else band_matrices(turn)

    def apply(self, field: str, read: Reader) -> np.ndarray:
        """[width, n] f64, the values of a field after the move. Positions are moved by the linear part only."""
        values = read(field)
        if self._still or field in ("opacity_logits", "sh_dc"):
            return values
        # Values that are not finite pass on to the checks of a scene.
        with np.errstate(over="ignore", invalid="ignore"):
            if field == "means":
                return product(self.linear, values)
            if field == "sh_rest":
                return turn_sh(values, self._bands)
            if self._uniform:
                return values + self._log_scale if field == "log_scales" else times(self._quat, values)
        quats, log_scales = (values, read("log_scales")) if field == "quats" else (read("quats"), values)
        return self._sheared(quats, log_scales)[field]

    def _sheared(self, quats: np.ndarray, log_scales: np.ndarray) -> dict[str, np.ndarray]:
        """Rotations and log-scales after a move that is no rotation; rows that are not valid stay as they are."""
        found = {"quats": quats.copy(), "log_scales": log_scales.copy()}
        largest = np.abs(quats).max(axis=0)
        good = np.isfinite(quats).all(axis=0) & (largest > 0) & (log_scales < np.inf).all(axis=0)
        if not good.any():
            return found
        # The largest numbers become 1 before anything is multiplied, so that nothing overflows.
        most = log_scales[:, good].max(axis=0)
        most = np.where(np.isneginf(most), 0.0, most)
        axes = matrices(quats[:, good] / largest[good]) * np.exp(log_scales[:, good] - most).T[:, None, :]
        moved = product(self.linear / self.size, axes.transpose(1, 0, 2)).transpose(1, 0, 2)
        left, scales, _ = np.linalg.svd(moved)
        left[np.linalg.det(left) < 0, :, 2] *= -1
        found["quats"][:, good] = quats_of(left)
        with np.errstate(divide="ignore"):
            found["log_scales"][:, good] = np.log(scales).T + most + np.log(self.size)
        return found


class GltfSource(PartsSource):
    """The splats of a glTF, one after the other.

    `name`: the user's path, for messages. `parts`: Gaussians, and where they are shown. `held_bytes`: bytes of their
    packed values.
    """

    def __init__(self, name: str, parts: Sequence[tuple[Splats, Move]], held_bytes: int) -> None:
        splats = [some for some, _ in parts]
        super().__init__(name, [some.count for some in splats], [some.sh_degree for some in splats], held_bytes)
        self._parts = parts
        sample = self.decode(origin_rows(self.count), "means") if self.count else np.zeros((3, 0))
        self.origin = choose_origin(sample.T)

    def decode_part(self, number: int, rows: Rows, field: str) -> np.ndarray:
        splats, move = self._parts[number]
        found = move.apply(field, partial(splats.decode, rows))
        if field == "means":
            with np.errstate(over="ignore", invalid="ignore"):
                found = found + (move.offset - self.origin)[:, None]
        return found
