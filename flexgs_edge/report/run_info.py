"""Records that every result holds: times and memory, the scene, the views."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

from flexgs_edge._version import __version__

SIMILARITIES = ("ssim", "flip", "lpips")  # Figures of pairs of pictures
PLY_HEADER_MOST = 4096  # Most bytes of the header of a PLY in INRIA's layout; most have 1.5 kB


def record(command: str, result: object, *left_out: str, **more: Any) -> dict[str, Any]:
    """The JSON values of a command's result: its fields but for some, and `more`."""
    return {"program": f"flexgs-edge {__version__}", "command": command, **fields_json(result, *left_out, **more)}


def fields_json(result: object, *left_out: str, **more: Any) -> dict[str, Any]:
    """The fields of a dataclass as JSON values. A `scene` is the `input`."""
    assert is_dataclass(result)
    names = [field.name for field in fields(result) if field.name not in (*left_out, *more)]
    return {"input" if name == "scene" else name: _value(getattr(result, name)) for name in names} | more


def _value(value: Any) -> Any:
    if hasattr(value, "to_json"):
        return value.to_json()
    if is_dataclass(value):
        return fields_json(value)
    if isinstance(value, Mapping):
        return {key: _value(one) for key, one in value.items()}
    return [_value(one) for one in value] if isinstance(value, (tuple, list)) else value


class Result(ABC):
    """What a command returns."""

    @abstractmethod
    def to_json(self) -> Any:
        """Return the record as JSON values."""

    @abstractmethod
    def summary(self) -> str:
        """Return the text that the command prints."""


@dataclass(frozen=True)
class RunInfo:
    """Times, memory and device of a run.

    `startup_seconds`, `compile_seconds`: seconds to open the device, and to build kernels. The stages that first needed
    them include both. `memory_limit`, `peak_memory`: the limit, and the largest resident memory of the process, bytes.
    With scratch files the peak includes their cached pages, which the operating system keeps until it needs the memory.
    `peak_anonymous`, `scratch`: the largest sampled resident memory that no file backs, and the most bytes in scratch
    files. `None` without scratch files.
    """

    seconds: float  # wall seconds of the whole run
    stages: dict[str, float]  # wall seconds by stage, in order of first entry
    startup_seconds: float
    compile_seconds: float
    memory_limit: int
    peak_memory: int
    device: dict[str, Any] | None  # the device that ran the kernels; `None` if nothing was drawn
    peak_anonymous: int | None = None
    scratch: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values, with seconds rounded to milliseconds."""
        return fields_json(
            self,
            "startup_seconds",
            "compile_seconds",
            seconds=round(self.seconds, 3),
            stages={name: round(seconds, 3) for name, seconds in self.stages.items()},
            startup_ms=round(self.startup_seconds * 1000, 1),
            compile_ms=round(self.compile_seconds * 1000, 1),
        )


@dataclass(frozen=True)
class SceneInfo:
    """An input scene.

    `count`, `sh_degree`: Gaussians and SH degree. `ply_bytes`, `ply_bytes_without_normals`: bytes of the scene as a PLY
    in INRIA's layout, and without its normals.
    """

    path: str  # as given
    count: int
    sh_degree: int
    ply_bytes: int
    ply_bytes_without_normals: int
    notes: tuple[str, ...] = ()  # values that the reader left out or changed
    bytes: int | None = None  # bytes of the input file, or of all files that were read; `None` for a scene from memory

    @property
    def plain(self) -> bool:
        """Whether the input is a PLY in INRIA's layout, by its bytes: only the header makes a difference then."""
        return self.bytes is None or 0 <= self.bytes - self.ply_bytes < PLY_HEADER_MOST

    def ratio_of(self, size: int) -> float | None:
        """Bytes of the input divided by `size`; `None` for a scene from memory."""
        return None if self.bytes is None else self.bytes / size


@dataclass(frozen=True)
class ViewsInfo:
    """The views of a run: their number, their split, and where they came from."""

    cameras: str
    images: str | None
    total: int
    train: int
    held_out: int
    width: int
    height: int
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class RemovedGroup:
    """Gaussians of one kind that a cleaning found."""

    kind: str
    count: int
    centre: tuple[float, float, float]  # median of their positions, world
    gain: float  # dB that the views which report gain without them; below 0: what they lose
    removed: bool = True  # False: they stay, since the views would lose

    def __str__(self) -> str:
        place = ", ".join(f"{value:.4g}" for value in self.centre)
        verdict = "" if self.removed else ", so they stay"
        loss = f"{'gain' if self.gain > 0 else 'loss'} {abs(self.gain):.4f} dB"
        change = "no view changes" if self.gain == 0 else loss
        return f"{self.count} {self.kind} (around {place}): {change}{verdict}"
