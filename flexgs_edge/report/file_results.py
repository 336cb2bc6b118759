"""Results of the commands that compare no pictures: from `decompress` to `devices`."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from flexgs_edge._version import __version__
from flexgs_edge.codec.header import Section
from flexgs_edge.report.run_info import RunInfo, SceneInfo, ViewsInfo
from flexgs_edge.report.summary import line, run_lines, scene_lines, text, view_lines
from flexgs_edge.units import format_mib, format_size, times_words

if TYPE_CHECKING:
    from flexgs_edge.kernels.choose_device import DeviceInfo


@dataclass(frozen=True)
class DecompressResult:
    """Result of `decompress`: the file it wrote."""

    scene: SceneInfo
    output: str
    size: int
    run: RunInfo
    notes: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        ratio = self.scene.ratio_of(self.size)
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "decompress",
            "input": self.scene.to_json(),
            "output": self.output,
            "size": self.size,
            "ratio_of_input": None if ratio is None else round(ratio, 4),
            "notes": list(self.notes),
            "run": self.run.to_json(),
        }

    def summary(self) -> str:
        """Return the text that the command prints."""
        lines = scene_lines("scene", self.scene)
        lines.append(line("wrote", f"{self.output}, {self.size} bytes ({format_size(self.size)})"))
        if self.scene.bytes is not None:
            change = (
                "as large as" if self.size == self.scene.bytes else f"{times_words(self.scene.bytes / self.size)} than"
            )
            lines.append(line("size", f"{change} the input's {format_size(self.scene.bytes)}"))
        lines += [line("note", note) for note in self.notes]
        return text([*lines, *run_lines(self.run)])


@dataclass(frozen=True)
class RenderResult:
    """Result of `render`: the files and the time of each view. `run` holds the times of start-up and kernel compilation."""

    scene: SceneInfo
    views: ViewsInfo
    files: tuple[str, ...]
    view_seconds: tuple[float, ...]
    warm_up_seconds: float
    run: RunInfo

    @property
    def ms_per_view(self) -> float:
        """Median time to draw a view, milliseconds. Loading, compiling and writing files are not included."""
        times = sorted(self.view_seconds)
        return 1000 * (times[(len(times) - 1) // 2] + times[len(times) // 2]) / 2 if times else 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        run = self.run.to_json()
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "render",
            "input": self.scene.to_json(),
            "views": self.views.to_json(),
            "files": list(self.files),
            "ms_per_view": round(self.ms_per_view, 3),
            "view_ms": [round(1000 * seconds, 3) for seconds in self.view_seconds],
            "startup_ms": run["startup_ms"],
            "compile_ms": run["compile_ms"],
            "warm_up_ms": round(1000 * self.warm_up_seconds, 1),
            "run": run,
        }

    def summary(self) -> str:
        """Return the text that the command prints."""
        lines = [*scene_lines("scene", self.scene), *view_lines(self.views)]
        first = self.files[0] if self.files else "no files"
        last = f" ... {self.files[-1]}" if len(self.files) > 1 else ""
        many = f"{len(self.files)} PNG files: " if len(self.files) != 1 else ""
        lines.append(line("wrote", f"{many}{first}{last}"))
        lines.append(
            line(
                "time",
                f"{self.ms_per_view:.1f} ms a view (median); start-up {1000 * self.run.startup_seconds:.0f} ms and "
                f"kernel compilation {1000 * self.run.compile_seconds:.0f} ms apart",
            )
        )
        return text([*lines, *run_lines(self.run)])


@dataclass(frozen=True)
class ScoreResult:
    """Result of `score`: the file of scores it wrote."""

    scene: SceneInfo
    views: ViewsInfo
    output: str
    score: str
    scored_views: int
    unseen: int
    run: RunInfo

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "score",
            "input": self.scene.to_json(),
            "views": self.views.to_json(),
            "output": self.output,
            "score": self.score,
            "scored_views": self.scored_views,
            "unseen": self.unseen,
            "run": self.run.to_json(),
        }

    def summary(self) -> str:
        """Return the text that the command prints."""
        lines = [*scene_lines("scene", self.scene), *view_lines(self.views)]
        unseen = f"; {self.unseen} Gaussians are in none of them" if self.unseen else ""
        lines.append(line("scored", f"{self.score}, over {self.scored_views} training poses{unseen}"))
        lines.append(line("wrote", self.output))
        return text([*lines, *run_lines(self.run)])


@dataclass(frozen=True)
class VerifyResult:
    """Result of `verify`: the parts of a file and their verdicts.

    Parameters
    ----------
    path : str
        The file.
    sections : tuple of Section
        Name, offset, bytes and verdict of each part, in the order of the file.
    """

    path: str
    sections: tuple[Section, ...]

    @property
    def ok(self) -> bool:
        """Whether every checksum matches."""
        return not self.damaged

    @property
    def damaged(self) -> tuple[str, ...]:
        """Names of the parts whose checksums do not match."""
        return tuple(section.name for section in self.sections if not section.ok)

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "verify",
            "path": self.path,
            "ok": self.ok,
            "sections": [asdict(section) for section in self.sections],
        }

    def summary(self) -> str:
        """Return the text that the command prints: one line per part."""
        parts, bad = self.sections, len(self.damaged)
        lines = [f"{s.name:<12} {s.length:>12} bytes at {s.offset:>12}  {'ok' if s.ok else 'DAMAGED'}" for s in parts]
        verdict = f"{bad} of {len(parts)} parts DAMAGED" if bad else "every checksum holds"
        lines.append(f"{self.path}: {sum(section.length for section in parts)} bytes, {verdict}")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class TrimResult:
    """Result of `trim`: layers, Gaussians and bytes before and after the cut; whether the new file is the preview of the old."""

    input: str
    input_size: int
    input_count: int
    input_layers: int
    output: str
    size: int
    count: int
    layers: int
    max_size: int
    is_preview: bool = False

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return {"program": f"flexgs-edge {__version__}", "command": "trim", **asdict(self)}

    def summary(self) -> str:
        """Return the text that the command prints."""
        lines = [
            f"{self.input}: {self.input_size} bytes ({format_size(self.input_size)}), "
            f"{self.input_count} Gaussians in {self.input_layers} layers",
            f"wrote {self.output}, {self.size} bytes ({format_size(self.size)}, {self.max_size} allowed)",
            f"kept  the preview, {self.count} Gaussians"
            if self.is_preview
            else f"kept  {self.layers} of {self.input_layers} layers, {self.count} of {self.input_count} Gaussians",
        ]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class ViewResult:
    """Result of `view`: the scene that was shown, and where.

    Parameters
    ----------
    scene : SceneInfo
        The input.
    size, views : int
        Bytes of the `.fgs` that was shown, and cameras to choose from.
    place : str
        The page that was written, or the address that was served.
    page_size : int or None
        Bytes of the page that was written.
    """

    scene: SceneInfo
    size: int
    views: int
    place: str
    page_size: int | None

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return {
            "program": f"flexgs-edge {__version__}",
            "command": "view",
            "input": self.scene.to_json(),
            "size": self.size,
            "views": self.views,
            "output" if self.page_size is not None else "address": self.place,
            "page_size": self.page_size,
        }

    def summary(self) -> str:
        """Return the text that the command prints."""
        lines = scene_lines("scene", self.scene)
        lines.append(line("shown", f"{self.size} bytes ({format_size(self.size)}), {self.views} cameras"))
        if self.page_size is None:
            lines.append(line("served", self.place))
        else:
            lines.append(line("wrote", f"{self.place}, {self.page_size} bytes ({format_size(self.page_size)})"))
        return text(lines)


@dataclass(frozen=True)
class DevicesResult:
    """Result of `devices`: the OpenCL devices, and the chosen one.

    Parameters
    ----------
    devices : tuple of DeviceInfo
        Limits and self-test verdict of each device.
    chosen : int or None
        Index of the chosen device; `None` if no device works, or not the one asked for.
    reason : str
        Why this device was chosen, or why none was.
    """

    devices: tuple[DeviceInfo, ...]
    chosen: int | None
    reason: str

    def to_json(self) -> dict[str, Any]:
        """Return the record as JSON values."""
        return {"devices": [info.to_json() for info in self.devices], "chosen": self.chosen, "reason": self.reason}

    def summary(self) -> str:
        """Return the text that the command prints: a few lines per device."""
        lines = [line for info in self.devices for line in _device_lines(info)]
        if self.chosen is not None:
            lines.append(f"chosen: [{self.chosen}] ({self.reason})")
        return "".join(line + "\n" for line in lines)


def _device_lines(info: DeviceInfo) -> list[str]:
    return [
        f"[{info.index}] {info.name}",
        f"    {info.type}, {info.platform}, driver {info.driver}, {info.opencl_c}",
        f"    {info.compute_units} compute units, native float vectors of {info.native_width}, work-groups up to "
        f"{info.max_work_group}, local memory {info.local_bytes // 1024} KiB, global memory {format_mib(info.global_bytes)}, "
        f"buffers up to {format_mib(info.max_alloc_bytes)}",
        f"    self-test: {info.self_test}",
    ]
