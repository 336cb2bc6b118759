"""Chunks of a scene on the backend, and the two ways to fill them: values of a source, or codes dequantized there."""

from __future__ import annotations

import math
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from flexgs_edge.constants import DEQUANTIZE_ROWS, EXTENT_SLACK, LOG2_255, ROW_BLOCK
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.packed.quantize import QuantizedArray, QuantizedScene
from flexgs_edge.render.fit import padded
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import SceneSource

SIGMAS = math.sqrt((LOG2_255 + EXTENT_SLACK) * 2.0 * math.log(2.0))
"""Standard deviations that the ellipse of an opaque splat reaches."""
ROUNDING = 1e-5
"""Bound of the float32 error in `project`, as a share of the largest term: generous, so that no block vanishes by rounding."""
LARGER = 1.001  # Factor that widens the extent of a block against rounding


@dataclass(frozen=True)
class ChunkBounds:
    """Bounds of the blocks of one chunk of a scene: ROW_BLOCK rows each, in row order.

    `middle`, `half`: [3, blocks] f64, centre and half size of the box around the means, scene units relative to the origin.
    """

    middle: np.ndarray
    half: np.ndarray
    # [blocks] f64, largest standard deviation of any Gaussian along any of its own axes, scene units.
    extent: np.ndarray

    @classmethod
    def of(cls, means: np.ndarray, log_scales: np.ndarray) -> ChunkBounds:
        """Bounds of rows with these stored values ([3, n] f32 each, n > 0). If one is not finite, every view sees its block."""
        starts = np.arange(0, means.shape[1], ROW_BLOCK)
        low, high = (ends.reduceat(means, starts, axis=1).astype(np.float64) for ends in (np.minimum, np.maximum))
        largest = np.maximum.reduceat(log_scales, starts, axis=1).max(axis=0).astype(np.float64)
        with np.errstate(over="ignore", invalid="ignore"):
            return cls((low + high) / 2, (high - low) / 2, LARGER * np.exp(largest))

    def seen(self, record: np.ndarray) -> np.ndarray:
        """[blocks] bool, whether a view may show a row of each block; `record` is its `camera_record` ([32] f32)."""
        camera = record.astype(np.float64)
        rotation, shift = camera[:9].reshape(3, 3), camera[9:12]
        (fx, fy, cx, cy), (width, height), dilation = camera[12:16], camera[24:26], camera[26]
        slopes = [math.hypot(1.0, np.abs(camera[at : at + 2]).max()) for at in (17, 19)]
        with np.errstate(over="ignore", invalid="ignore"):
            # Reach: `spread` times the extent at depth 1, in scene units, and `pixels` at any.
            spread = [SIGMAS * abs(f) * slope for f, slope in zip((fx, fy), slopes, strict=True)]
            pixels = SIGMAS * math.sqrt(dilation)
            # The sides of the picture, near plane first: its axis, and the factors of x or y and of depth.
            axis = [0, 0, 0, 1, 1]
            across = np.array([0.0, fx, -fx, fy, -fy])
            deep = np.array([1.0, cx + 1 + pixels, width - cx + pixels, cy + 1 + pixels, height - cy + pixels])
            room = np.empty((len(axis), len(self.extent)))
            room[0], room[1:] = -camera[16], np.outer(np.repeat(spread, 2), self.extent)
            # Their values at the middles of the boxes, and how much more at the corner where they are largest.
            factors = across[:, None] * rotation[axis] + deep[:, None] * rotation[2]
            offsets = across * shift[axis] + deep * shift[2]
            most = factors @ self.middle + np.abs(factors) @ self.half + room + offsets[:, None]
            # The sizes of all terms bound how much is rounded.
            sizes = np.abs(across)[:, None] * np.abs(rotation[axis]) + np.abs(deep)[:, None] * np.abs(rotation[2])
            constant = np.abs(across * shift[axis]) + np.abs(deep * shift[2])
            terms = sizes @ (np.abs(self.middle) + self.half) + np.abs(room) + constant[:, None]
            outside: np.ndarray = (most < -ROUNDING * terms).any(axis=0)
        return ~outside


@dataclass(frozen=True)
class ViewPart:
    """The rows of a chunk that a view may show: whole blocks, in row order, side by side in the arrays of the view."""

    chunk_base: int  # the chunk's first row in the scene
    count: int  # rows of the part
    base: int  # its first row in the view's arrays
    first: int  # place of its first block in `blocks`
    blocks: Any  # [.] u32, blocks of this chunk and of others, by their numbers within their chunks
    seen: np.ndarray  # [.] u32, the blocks of this part

    @classmethod
    def of(cls, chunk: Chunk, seen: np.ndarray, base: int, first: int, blocks: Any) -> ViewPart:
        """The part of the blocks `seen` ([.] u32, ascending) of a chunk."""
        count = len(seen) * ROW_BLOCK
        if len(seen) and seen[-1] == chunk.blocks - 1:
            count -= chunk.blocks * ROW_BLOCK - chunk.count
        return cls(chunk.base, count, base, first, blocks, seen)

    @property
    def rows(self) -> np.ndarray:
        """[count] u32, the rows of the scene."""
        rows = self.seen[:, None] * np.uint32(ROW_BLOCK) + np.arange(ROW_BLOCK, dtype=np.uint32)
        return np.uint32(self.chunk_base) + rows.reshape(-1)[: self.count]


@dataclass
class Chunk:
    """Planes of rows [base, base + count) of a scene, ready for the kernel `project`."""

    base: int
    count: int
    stride: int
    degree: int
    means: Any
    cov: Any
    log2_opacity: Any
    sh_dc: Any
    sh_rest: Any

    @property
    def arrays(self) -> tuple[Any, ...]:
        """All planes."""
        return self.means, self.cov, self.log2_opacity, self.sh_dc, self.sh_rest

    @property
    def blocks(self) -> int:
        """Blocks of ROW_BLOCK rows."""
        return -(-self.count // ROW_BLOCK)

    def project(self, backend: Backend, camera: Any, part: ViewPart, antialiased: bool, out: tuple[Any, ...]) -> None:
        """Project the rows of a part to splat records, depth keys and bounds of tiles."""
        backend.launch(
            "project", (padded(part.count),), part.count, self.stride, part.base, part.first, self.degree,
            int(antialiased), part.blocks, camera, *self.arrays, *out,
        )  # fmt: skip

    def release(self) -> None:
        """Free the planes."""
        for array in self.arrays:
            array.release()


class ChunkArrays:
    """The arrays of a chunk on the backend: stored planes, and the planes that `activate` computes from them."""

    def __init__(self, backend: Backend, degree: int, stride: int) -> None:
        self.backend, self.degree, self.stride = backend, degree, stride
        shapes = {name: (field.width(degree), stride) for name, field in FIELD.items()}
        self.stored = {name: backend.array(shape, np.float32) for name, shape in shapes.items()}
        self.cov = backend.array((6, stride), np.float32)
        self.log2_opacity = backend.array((stride,), np.float32)

    def chunk(self, base: int, count: int) -> Chunk:
        """The planes as a chunk of rows [base, base + count)."""
        stored = self.stored
        colours = stored["sh_dc"], stored["sh_rest"]
        return Chunk(base, count, self.stride, self.degree, stored["means"], self.cov, self.log2_opacity, *colours)

    def activated(self, base: int, count: int, antialiased: bool) -> Chunk:
        """Activate the stored rows, and return them as a chunk."""
        stored, stride = self.stored, self.stride
        self.backend.launch(
            "activate", (stride,), stride, int(antialiased), stored["log_scales"], stored["quats"],
            stored["opacity_logits"], self.cov, self.log2_opacity,
        )  # fmt: skip
        return self.chunk(base, count)

    def release_raw(self) -> None:
        """Free the planes that only `activate` reads."""
        for name in ("log_scales", "quats", "opacity_logits"):
            self.stored[name].release()

    def release(self) -> None:
        """Free everything."""
        for array in (*self.stored.values(), self.cov, self.log2_opacity):
            array.release()


class ChunkPlanes(Protocol):
    """Fills the chunks of a scene, the rows with SH first."""

    count: int
    sh_count: int
    sh_degree: int
    origin: np.ndarray
    bounds: dict[int, ChunkBounds]  # bounds of chunks that are known so far, by their first rows

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        """Fill arrays of the backend with rows [start, stop), [width, padded(stop - start)] by field name."""

    def close(self) -> None:
        """Free what is held."""


class SourcePlanes:
    """Fills chunks from a `SceneSource`. Its colours may change between views; its means and scales may not."""

    def __init__(self, backend: Backend, source: SceneSource) -> None:
        self.backend = backend
        self.source = source
        self.count, self.sh_count, self.sh_degree = source.count, source.sh_count, source.sh_degree
        self.origin = source.origin
        self.bounds: dict[int, ChunkBounds] = {}  # Bounds of the chunks loaded so far, by their first rows

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        with ExitStack() as maps:
            host = {
                name: maps.enter_context(self.backend.mapped(array))[:, : stop - start]
                for name, array in planes.items()
                if array.shape[0]
            }
            self.source.read(slice(start, stop), list(host), host)
            if start not in self.bounds:
                self.bounds[start] = ChunkBounds.of(host["means"], host["log_scales"])

    def close(self) -> None:
        """Nothing is held."""


class QuantizedPlanes:
    """Fills chunks from a quantized scene: codes and ranges go to the backend once, and each chunk is dequantized there."""

    def __init__(self, backend: Backend, quantized: QuantizedScene) -> None:
        self.backend = backend
        self.count, self.sh_count, self.sh_degree = quantized.count, quantized.sh_count, quantized.sh_degree
        self.origin = quantized.origin
        self.bounds: dict[int, ChunkBounds] = {}  # no bounds: every view draws all chunks
        self._contraction = quantized.contraction
        self._arrays: dict[str, tuple[QuantizedArray, Any, Any, Any]] = {}
        for name, array in quantized.arrays.items():
            # Three spare bytes: the kernel reads each code through a window of three bytes.
            codes = backend.array((array.planes.size + 3,), np.uint8)
            backend.write(codes, array.planes.reshape(-1))
            low = backend.array(array.low.shape, np.float32)
            step = backend.array(array.step.shape, np.float32)
            backend.write(low, array.low)
            backend.write(step, array.step)
            self._arrays[name] = (array, codes, low, step)

    def load(self, start: int, stop: int, planes: dict[str, Any]) -> None:
        rows = stop - start
        for name, plane in planes.items():
            width, stride = plane.shape
            if width == 0:
                continue
            array, codes, low, step = self._arrays[name]
            size = (-(-rows // DEQUANTIZE_ROWS), width)
            self.backend.launch(
                "dequantize", size, array.count, array.groups, array.bits, array.planes.shape[1], start, rows, stride,
                codes, low, step, plane,
            )  # fmt: skip
            if name == "means" and self._contraction is not None:
                # A map would not wait for the kernel.
                host = self.backend.read(plane)
                host[:, :rows] = self._contraction.expand(host[:, :rows])
                self.backend.write(plane, host)

    def close(self) -> None:
        """Free codes and ranges."""
        for _, *arrays in self._arrays.values():
            for array in arrays:
                array.release()
        self._arrays = {}
