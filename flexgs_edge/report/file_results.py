"""Results of the commands that compare no pictures: from `decompress` to `devices`."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flexgs_edge.codec.sections import Section
from flexgs_edge.report.run_info import Result, RunInfo, SceneInfo, ViewsInfo, record
from flexgs_edge.report.summary import line, run_lines, scene_lines, text, view_lines
from flexgs_edge.units import format_mib, format_size, times_words

if TYPE_CHECKING:
    from flexgs_edge.kernels.choose_device import DeviceInfo


@dataclass(frozen=True)
class ConversionLoss:
    """What a file in another program's format lost of its scene.

    `fidelity`, `worst`: PSNR of the file's pictures against the scene's, dB: mean and worst view; `None` if identical
    or not drawn.
    """

    # Median and largest errors of positions (scene units, and over the splat's size), log-scales, opacities and colours.
    values: dict[str, tuple[float, float]]
    views: int = 0  # views that were compared, drawn by `cameras`
    cameras: str = ""
    fidelity: float | None = None
    worst: float | None = None
    drop: float | None = None  # drop against the photos, or modelled drop from `base_psnr`, dB
    base_psnr: float | None = None  # `None` where photos tell
    why: str = ""  # why no pictures were compared

    def lines(self) -> list[str]:
        """Lines of the summary."""
        lines = []
        if self.values:
            median, most = self.values["position_by_size"]
            opacity, colour = self.values["opacity"][1], self.values["colour"][1]
            moved = (
                f"positions move by {100 * median:.2g} % of a splat's size in the median, {100 * most:.2g} % at most"
            )
            lines.append(line("values", f"{moved}; opacities by up to {opacity:.2g}, colours by {colour:.2g}"))
        if not self.views:
            return [*lines, line("pictures", f"not compared: {self.why}")]
        same = "the same pictures"
        if self.fidelity is not None:
            same = f"fidelity {self.fidelity:.2f} dB, worst {self.worst:.2f} dB"
        lost = f"drop {self.drop:.3f} dB against the photos"
        if self.base_psnr is not None:
            lost = f"modelled drop {self.drop:.3f} dB from a base of {self.base_psnr:g} dB"
        return [*lines, line("pictures", f"{same}; {lost} ({self.views} views, cameras from {self.cameras})")]


@dataclass(frozen=True)
class DecompressResult(Result):
    """Result of `decompress`: the file it wrote, and for other programs' formats what they lost."""

    scene: SceneInfo
    output: str
    size: int
    run: RunInfo
    notes: tuple[str, ...] = ()
    loss: ConversionLoss | None = None
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        ratio = self.scene.ratio_of(self.size)
        return record("decompress", self, ratio_of_input=None if ratio is None else round(ratio, 4))

    def summary(self) -> str:
        lines = scene_lines("scene", self.scene)
        lines.append(line("wrote", f"{self.output}, {self.size} bytes ({format_size(self.size)})"))
        if self.scene.bytes is not None:
            times = f"{times_words(self.scene.bytes / self.size)} than"
            change = "as large as" if self.size == self.scene.bytes else times
            lines.append(line("size", f"{change} the input's {format_size(self.scene.bytes)}"))
        lines += [] if self.loss is None else self.loss.lines()
        lines += [line("note", note) for note in self.notes]
        return text([*lines, *run_lines(self.run)])


@dataclass(frozen=True)
class RenderResult(Result):
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
        run = self.run.to_json()
        return record(
            "render",
            self,
            "view_seconds",
            "warm_up_seconds",
            ms_per_view=round(self.ms_per_view, 3),
            view_ms=[round(1000 * seconds, 3) for seconds in self.view_seconds],
            startup_ms=run["startup_ms"],
            compile_ms=run["compile_ms"],
            warm_up_ms=round(1000 * self.warm_up_seconds, 1),
        )

    def summary(self) -> str:
        lines = [*scene_lines("scene", self.scene), *view_lines(self.views)]
        first = self.files[0] if self.files else "no files"
        last = f" ... {self.files[-1]}" if len(self.files) > 1 else ""
        many = f"{len(self.files)} PNG files: " if len(self.files) != 1 else ""
        lines.append(line("wrote", f"{many}{first}{last}"))
        start = f"start-up {1000 * self.run.startup_seconds:.0f} ms"
        build = f"kernel compilation {1000 * self.run.compile_seconds:.0f} ms"
        lines.append(line("time", f"{self.ms_per_view:.1f} ms a view (median); {start} and {build} apart"))
        return text([*lines, *run_lines(self.run)])


@dataclass(frozen=True)
class VerifyResult(Result):
    """Result of `verify`: the parts of a file and their verdicts."""

    path: str  # the file
    sections: tuple[Section, ...]  # name, offset, bytes and verdict of each part, in the order of the file

    @property
    def ok(self) -> bool:
        """Whether every checksum matches."""
        return not self.damaged

    @property
    def damaged(self) -> tuple[str, ...]:
        """Names of the parts whose checksums do not match."""
        return tuple(section.name for section in self.sections if not section.ok)

    def to_json(self) -> dict[str, Any]:
        return record("verify", self, ok=self.ok)

    def summary(self) -> str:
        parts, bad = self.sections, len(self.damaged)
        lines = [f"{s.name:<12} {s.length:>12} bytes at {s.offset:>12}  {'ok' if s.ok else 'DAMAGED'}" for s in parts]
        verdict = f"{bad} of {len(parts)} parts DAMAGED" if bad else "every checksum holds"
        lines.append(f"{self.path}: {sum(section.length for section in parts)} bytes, {verdict}")
        return "\n".join(lines) + "\n"


@dataclass(frozen=True)
class TrimResult(Result):
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
        return record("trim", self)

    def summary(self) -> str:
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
class ViewResult(Result):
    """Result of `view`: the scene that was shown, and where.

    `size`, `views`: bytes of the `.fgs` that was shown, and cameras to choose from.
    """

    scene: SceneInfo  # the input
    size: int
    views: int
    place: str  # the page that was written, or the address that was served
    page_size: int | None  # bytes of the page that was written

    def to_json(self) -> dict[str, Any]:
        return record("view", self, "place", **{"output" if self.page_size is not None else "address": self.place})

    def summary(self) -> str:
        lines = scene_lines("scene", self.scene)
        lines.append(line("shown", f"{self.size} bytes ({format_size(self.size)}), {self.views} cameras"))
        if self.page_size is None:
            lines.append(line("served", self.place))
        else:
            lines.append(line("wrote", f"{self.place}, {self.page_size} bytes ({format_size(self.page_size)})"))
        return text(lines)


@dataclass(frozen=True)
class DevicesResult(Result):
    """Result of `devices`: the OpenCL devices, and the chosen one."""

    devices: "tuple[DeviceInfo, ...]"  # limits and self-test verdict of each device
    chosen: int | None  # index of the chosen device; `None` if no device works, or not the one asked for
    reason: str  # why this device was chosen, or why none was

    def to_json(self) -> dict[str, Any]:
        return {"devices": [info.to_json() for info in self.devices], "chosen": self.chosen, "reason": self.reason}

    def summary(self) -> str:
        lines = []
        for info in self.devices:
            lines += [
                f"[{info.index}] {info.name}",
                f"    {info.type}, {info.platform}, driver {info.driver}, {info.opencl_c}",
                f"    {info.compute_units} compute units, native float vectors of {info.native_width}, work-groups up to "
                f"{info.max_work_group}, local memory {info.local_bytes // 1024} KiB, global memory "
                f"{format_mib(info.global_bytes)}, buffers up to {format_mib(info.max_alloc_bytes)}",
                f"    self-test: {info.self_test}",
            ]
        if self.chosen is not None:
            lines.append(f"chosen: [{self.chosen}] ({self.reason})")
        return "".join(line + "\n" for line in lines)
