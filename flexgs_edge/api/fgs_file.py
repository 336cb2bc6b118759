"""An open `.fgs` file: its header, its layers, its checksums."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.api.scene import Scene
from flexgs_edge.api.words import StrPath
from flexgs_edge.codec.open_fgs import file_version, open_fgs, read_header
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.commands.trim import trim
from flexgs_edge.commands.verify import verify
from flexgs_edge.errors import InputError
from flexgs_edge.report.file_results import TrimResult, VerifyResult
from flexgs_edge.report.info_result import InfoResult
from flexgs_edge.run.contents import contents
from flexgs_edge.run.inputs import CheckedScene, checked_scene


@dataclass(frozen=True)
class Layer:
    """A layer of a file: its number of Gaussians, and the bytes of their chunks."""

    count: int
    bytes: int


class FgsFile:
    """A `.fgs` file whose header has been read and checked. Values are decoded when they are read.

    Parameters
    ----------
    path : path
        The file. It is opened for each read and not kept open.

    Attributes
    ----------
    path : Path
        The path as given.
    version, count, sh_degree : int
        Format version, number of Gaussians, SH degree.
    settings : dict
        How the file was made.

    Raises
    ------
    FormatError
        If the header does not follow the format.
    """

    def __init__(self, path: StrPath) -> None:
        self.path = Path(path)
        header = read_header(self.path)
        self.version = file_version(self.path)
        self.count: int = header.count
        self.sh_degree: int = header.sh_degree
        self.settings: dict[str, Any] = dict(header.settings)
        self._rows = tuple(header.layers) if isinstance(header, GridHeader) else (header.count,)

    @cached_property
    def info(self) -> InfoResult:
        """Result of the command `info`. A file that was cut must be decoded for it, which takes longer."""
        return contents(self.path)

    @property
    def channels(self) -> Mapping[str, Mapping[str, Any]]:
        """Rows, precision and bytes of every channel, by its name."""
        return self.info.channels

    @property
    def layers(self) -> tuple[Layer, ...]:
        """The layers, from coarse to fine. A file of version 1 is one layer."""
        if self.info.layers is None:
            return (Layer(self.count, sum(int(channel["bytes"]) for channel in self.channels.values())),)
        return tuple(Layer(layer["rows"], layer["bytes"]) for layer in self.info.layers)

    def scene(self, layers: int | None = None) -> Scene:
        """Open the scene of the first `layers` layers. Default: all layers."""
        last = len(self._rows) if layers is None else layers
        if not 1 <= last <= len(self._rows):
            raise InputError(f"layers: expected 1 to {len(self._rows)}, found {layers}")
        return self._part(0, sum(self._rows[:last]))

    def layer(self, k: int) -> Scene:
        """Open the Gaussians of layer `k`, counted from 0. Added to the layers before it, they refine the scene."""
        if not 0 <= k < len(self._rows):
            raise InputError(f"layer: expected 0 to {len(self._rows) - 1}, found {k}")
        return self._part(sum(self._rows[:k]), sum(self._rows[: k + 1]))

    def verify(self) -> VerifyResult:
        """Check every byte against its checksum."""
        return verify(self.path)

    def trim(self, output: StrPath, max_size: int, *, force: bool = False) -> TrimResult:
        """Copy as many whole layers as fit into `max_size` bytes to the file `output`."""
        return trim(self.path, output, max_size, force)

    def _part(self, start: int, stop: int) -> Scene:
        whole = self._whole
        if (start, stop) == (0, whole.source.count):
            return Scene(whole)
        if start == stop:
            raise InputError(f"{self.path}: this layer is empty")
        source = whole.source.select(np.arange(start, stop))
        return Scene(CheckedScene(self.path, source, source.count, source.sh_degree, whole.settings))

    @cached_property
    def _whole(self) -> CheckedScene:
        return replace(checked_scene(open_fgs(self.path), self.path), file_bytes=self.path.stat().st_size)

    def __repr__(self) -> str:
        return f"FgsFile({str(self.path)!r}: version {self.version}, {self.count} Gaussians)"


def open(path: StrPath) -> FgsFile:
    """Open a `.fgs` file. Reads and checks the header; values are decoded when they are read."""
    return FgsFile(path)
