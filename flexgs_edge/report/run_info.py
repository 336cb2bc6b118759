"""Records of a run that every result holds: times and memory, the scene, the views."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class RunInfo:
    """What a run took, and on what it ran.

    Parameters
    ----------
    seconds : float
        Whole run.
    stages : dict
        Seconds by stage, in order.
    startup_seconds, compile_seconds : float
        Opening the device, and building kernels (part of the stages that first needed them).
    memory_limit, peak_memory : int
        The limit, and the largest resident memory of the process. With scratch files that counts their pages too, which the
        kernel leaves there as long as nobody needs the room.
    peak_anonymous, scratch : int or None
        The largest resident memory without a file behind it (sampled) and the most bytes in scratch files; `None` for runs
        without scratch files.
    device : dict or None
        What ran the kernels; `None` when nothing was rendered.
    """

    seconds: float
    stages: dict[str, float]
    startup_seconds: float
    compile_seconds: float
    memory_limit: int
    peak_memory: int
    device: dict[str, Any] | None
    peak_anonymous: int | None = None
    scratch: int | None = None

    def to_json(self) -> dict[str, Any]:
        """Seconds are rounded to milliseconds."""
        return {
            "seconds": round(self.seconds, 3),
            "stages": {name: round(seconds, 3) for name, seconds in self.stages.items()},
            "startup_ms": round(self.startup_seconds * 1000, 1),
            "compile_ms": round(self.compile_seconds * 1000, 1),
            "memory_limit": self.memory_limit,
            "peak_memory": self.peak_memory,
            "peak_anonymous": self.peak_anonymous,
            "scratch": self.scratch,
            "device": self.device,
        }


@dataclass(frozen=True)
class SceneInfo:
    """A scene that went in."""

    path: str
    count: int
    sh_degree: int
    ply_bytes: int
    ply_bytes_without_normals: int
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all fields as JSON values."""
        return {**asdict(self), "notes": list(self.notes)}


@dataclass(frozen=True)
class ViewsInfo:
    """The views of a run: how many there are, how they were split, and where they came from."""

    cameras: str
    images: str | None
    total: int
    train: int
    held_out: int
    width: int
    height: int
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return all fields as JSON values."""
        return {**asdict(self), "notes": list(self.notes)}
