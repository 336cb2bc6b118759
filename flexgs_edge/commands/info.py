"""`info`: what a file holds. Text and JSON come from one builder."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from flexgs_edge._version import __version__
from flexgs_edge.io.ply import inria_dtype
from flexgs_edge.run.open_scene import open_scene
from flexgs_edge.units import format_size


def info(path: str | Path) -> dict[str, Any]:
    """What a scene file holds, as JSON values (`info_text` makes the text from them).

    Parameters
    ----------
    path : path
        A `.fgs` (its header is read; one that was cut is decoded, since entropy coding shares the bytes out), a `.ply`, a
        file of another program's format or a model folder.
    """
    place = Path(path)
    if place.suffix.lower() == ".fgs":
        # Imports the coder, which a .ply does not need.
        from flexgs_edge.run.contents import contents

        if place.is_file():
            return contents(place)
    return _scene_info(place)


def _scene_info(path: Path) -> dict[str, Any]:
    # Imports cameras, options and other programs' formats, none of which a .fgs needs.
    from flexgs_edge.io.formats import format_of
    from flexgs_edge.run.companions import companions_of

    source = open_scene(path)
    beside = companions_of(path)
    place = Path(source.name)
    foreign = format_of(place)
    ply = source.count * inria_dtype(source.sh_degree).itemsize
    return {
        "program": f"flexgs-edge {__version__}",
        "command": "info",
        "path": source.name,
        "format": (foreign.suffix if foreign else place.suffix.lower()).lstrip("."),
        "size": os.stat(place).st_size,
        "count": source.count,
        "sh_count": source.sh_count,
        "sh_degree": source.sh_degree,
        "origin": source.origin.tolist(),
        "source_ply_bytes": ply,
        "cameras": None if beside.cameras is None else os.fspath(beside.cameras),
        "images": None if beside.images is None else os.fspath(beside.images),
        "antialiased": getattr(source, "settings", {}).get("antialiased", beside.antialiased),
        "notes": list(source.notes),
    }


def info_text(found: dict[str, Any]) -> str:
    """The text of what `info` found."""
    version = f" version {found['version']}" if "version" in found else ""
    lines = [f"{found['path']}: {found['format']}{version}, {found['size']} bytes ({format_size(found['size'])})"]
    with_sh = f", {found['sh_count']} of them with SH" if found["format"] == "fgs" else ""
    lines.append(f"Gaussians:   {found['count']}{with_sh}, SH degree {found['sh_degree']}")
    if found.get("ratio"):
        of = f"of the original's PLY, {format_size(found['source_ply_bytes'])}"
        each = f"; {found['bits_per_gaussian']:.1f} bits a Gaussian kept" if found["count"] else ""
        lines.append(f"ratio:       {found['ratio']:.2f}x {of}{each}")
    if any(found["origin"]):
        lines.append("origin:      " + ", ".join(f"{value:g}" for value in found["origin"]))
    for word in ("cameras", "images"):
        if word in found:
            lines.append(f"{word + ':':<12} {found[word] or 'none beside it'}")
    if found.get("antialiased"):
        lines.append("antialiased: yes")
    lines += [f"note:        {note}" for note in found["notes"]]
    lines += _layer_lines(found)
    if "channels" in found:
        lines += ["", *_channel_table(found["channels"], found["version"])]
        if "chroma" in found:
            lines.append(f"steps of dc and sh are those of luma; of chroma, {found['chroma']:g} times as much")
        lines.append(_overhead_line(found))
        lines += ["", "settings:", *_settings_lines(found["settings"])]
    return "\n".join(lines) + "\n"


def _layer_lines(found: dict[str, Any]) -> list[str]:
    lines = []
    if len(found.get("layers", ())) > 1:
        parts = (f"{layer['rows']} in {layer['bytes']} bytes" for layer in found["layers"])
        lines.append(f"layers:      {len(found['layers'])} (Gaussians: {', '.join(parts)}); see flexgs-edge trim")
    if found.get("cut_from"):
        cut = found["cut_from"]
        lines.append(f"cut from:    {cut['bytes']} bytes, {cut['count']} Gaussians in {cut['layers']} layers")
    return lines


def _overhead_line(found: dict[str, Any]) -> str:
    model = f" (of these the coder's tables: {found['model_bytes']})" if "model_bytes" in found else ""
    return f"headers and checksums: {found['overhead_bytes']} bytes{model}"


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


def _channel_table(channels: dict[str, dict[str, Any]], version: int) -> list[str]:
    columns = _PACKED_COLUMNS if version == 1 else _GRID_COLUMNS
    rows = [("attribute", *columns)]
    for name, item in channels.items():
        rows.append((name, *(_cell(item[word]) for word in columns.values())))
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    return [
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    ]


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def _settings_lines(settings: dict[str, Any]) -> list[str]:
    lines = []
    for name, value in settings.items():
        if isinstance(value, dict):
            value = ", ".join(f"{key} {'none' if item is None else item}" for key, item in value.items())
        lines.append(f"  {name.replace('_', ' ')}: {'none' if value is None else value}")
    return lines
