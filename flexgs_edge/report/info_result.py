"""Result of `info`, as values, as JSON and as text."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from flexgs_edge.report.run_info import Result, record
from flexgs_edge.report.summary import aligned
from flexgs_edge.units import format_size


@dataclass(frozen=True)
class InfoResult(Result):
    """Contents of a scene file.

    `count`, `sh_count`, `sh_degree`: Gaussians, those that may have SH above degree 0, and the SH degree. `cameras`,
    `images`: cameras and photos beside a file of another format.
    """

    path: str  # the file; for a model folder, its latest scene
    format: str  # `fgs`, `ply`, `spz`, `sog`, `compressed.ply`, ...: by the file's first bytes, if they tell
    size: int  # bytes of the file, or of all files that are read
    count: int
    sh_count: int
    sh_degree: int
    origin: tuple[float, ...]  # offset that the file subtracts from the positions, world coordinates
    source_ply_bytes: int | None  # bytes of the scene as a PLY; for a `.fgs`, of the original if the file states it
    notes: tuple[str, ...] = ()  # values that the reader left out or changed
    # Version of the `.fgs` format. Other formats have `None` here, and leave all fields up to `cut_from` empty.
    version: int | None = None
    # Rows, precision and bytes of every channel, by its name.
    channels: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)  # how the file was made
    chroma: float | None = None  # step size of chroma, relative to that of luma (version 2)
    model_bytes: int | None = None  # bytes of the coder's tables (version 2)
    layers: tuple[Mapping[str, int], ...] | None = None  # rows and bytes of every layer (version 2)
    preview: Mapping[str, int] | None = None  # rows and bytes of the preview (version 2); None if there is none
    cut_from: Mapping[str, int] | None = None  # size and rows of the file before `trim` (version 2)
    cameras: str | None = None
    images: str | None = None
    # Whether a file of another format, or its model folder, asks for antialiased drawing; `None`: neither says so.
    antialiased: bool | None = None
    format_version: int | None = None  # version of another format, if the file states one
    # Corners of the box that holds nine tenths of the positions along each axis; `None` for a `.fgs`, whose header is read alone.
    bounds: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    frame: str | None = None  # directions of the axes in a file of another format, such as `RUB`; it is read into RDF

    @property
    def ratio(self) -> float | None:
        """Bytes of the original's PLY divided by those of the `.fgs`, to four digits."""
        return round(self.source_ply_bytes / self.size, 4) if self.version and self.source_ply_bytes else None

    @property
    def bits_per_gaussian(self) -> float | None:
        """Bits of the `.fgs` per Gaussian, to three digits."""
        return round(8 * self.size / self.count, 3) if self.version and self.count else None

    @property
    def overhead_bytes(self) -> int:
        """Bytes of the `.fgs` that belong to no channel, and not to its preview."""
        preview = 0 if self.preview is None else self.preview["bytes"]
        return self.size - sum(int(channel["bytes"]) for channel in self.channels.values()) - preview

    def to_json(self) -> dict[str, Any]:
        of_other = ("cameras", "images", "antialiased", "format_version", "frame", "bounds")
        of_version_2 = ("chroma", "model_bytes", "layers", "preview", "cut_from")
        if self.version is None:
            return record("info", self, "version", "channels", "settings", *of_version_2)
        left_out = of_other if self.layers is not None else (*of_other, *of_version_2)
        derived = {name: getattr(self, name) for name in ("bits_per_gaussian", "ratio", "overhead_bytes")}
        return record("info", self, *left_out, **derived)

    def summary(self) -> str:
        number = self.format_version if self.version is None else self.version
        version = "" if number is None else f" version {number}"
        lines = [f"{self.path}: {self.format}{version}, {self.size} bytes ({format_size(self.size)})"]
        with_sh = "" if self.version is None else f", {self.sh_count} of them with SH"
        lines.append(f"Gaussians:   {self.count}{with_sh}, SH degree {self.sh_degree}")
        if self.ratio and self.source_ply_bytes is not None:
            each = "" if self.bits_per_gaussian is None else f"; {self.bits_per_gaussian:.1f} bits a Gaussian kept"
            lines.append(
                f"ratio:       {self.ratio:.2f}x of the original's PLY, {format_size(self.source_ply_bytes)}{each}"
            )
        if any(self.origin):
            lines.append("origin:      " + ", ".join(f"{value:g}" for value in self.origin))
        if self.bounds is not None:
            low, high = (", ".join(f"{value:.4g}" for value in corner) for corner in self.bounds)
            lines.append(f"bounds:      {low} to {high} (nine tenths of the Gaussians)")
        if self.version is None:
            for word, beside in (("cameras:", self.cameras), ("images:", self.images)):
                lines.append(f"{word:<12} {beside or 'none beside it'}")
            turned = "" if self.frame in (None, "RDF") else ", turned into RDF (x right, y down, z forward)"
            lines.append(f"axes:        {self.frame}{turned}")
            said = {True: "yes", False: "no", None: "not said"}[self.antialiased]
            lines.append(f"antialiased: {said}")
        lines += [f"note:        {note}" for note in self.notes]
        if self.layers is not None:
            lines += _layer_lines(self.layers, self.cut_from)
        if self.preview is not None:
            lines.append(f"preview:     {self.preview['rows']} Gaussians in {self.preview['bytes']} bytes")
        if self.version is not None:
            lines += ["", *_channel_table(self.channels, self.version)]
            if self.chroma is not None:
                lines.append(f"steps of dc and sh are those of luma; of chroma, {self.chroma:g} times as much")
            model = "" if self.model_bytes is None else f" (of these the coder's tables: {self.model_bytes})"
            lines.append(f"headers and checksums: {self.overhead_bytes} bytes{model}")
            lines += ["", "settings:", *_settings_lines(self.settings)]
        return "\n".join(lines) + "\n"


def _layer_lines(layers: Sequence[Mapping[str, int]], cut: Mapping[str, int] | None) -> list[str]:
    lines = []
    if len(layers) > 1:
        parts = (f"{layer['rows']} in {layer['bytes']} bytes" for layer in layers)
        lines.append(f"layers:      {len(layers)} (Gaussians: {', '.join(parts)}); see flexgs-edge trim")
    if cut:
        lines.append(f"cut from:    {cut['bytes']} bytes, {cut['count']} Gaussians in {cut['layers']} layers")
    return lines


_PACKED_COLUMNS = {
    "channels": "channels",
    "rows": "rows",
    "bits": "bits",
    "groups": "groups",
    "bytes a channel": "bytes_per_channel",
    "ranges": "range_bytes",
    "bytes": "bytes",
}
_GRID_COLUMNS = {
    "rows": "rows",
    "step": "step",
    "bits a row": "bits_per_row",
    "bits a Gaussian": "bits_per_gaussian",
    "bytes": "bytes",
}


def _channel_table(channels: Mapping[str, Mapping[str, Any]], version: int) -> list[str]:
    columns = _PACKED_COLUMNS if version == 1 else _GRID_COLUMNS
    rows = [(name, *(_cell(item[word]) for word in columns.values())) for name, item in channels.items()]
    return aligned([("attribute", *columns), *rows])


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _settings_lines(settings: Mapping[str, Any]) -> list[str]:
    lines = []
    for name, value in settings.items():
        if isinstance(value, list) and any(isinstance(item, list) for item in value):
            value = f"{len(value)} of them"
        if isinstance(value, dict):
            value = ", ".join(f"{key} {'none' if item is None else item}" for key, item in value.items())
        lines.append(f"  {name.replace('_', ' ')}: {'none' if value is None else value}")
    return lines
