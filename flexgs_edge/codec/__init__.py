"""The `.fgs` container: bytes only (docs/format.md). Importing it lets `open_scene` read `.fgs` files."""

from flexgs_edge.codec.container2 import channel_bytes, coded_size, trim_container, write_grid
from flexgs_edge.codec.grid_source import GridSource
from flexgs_edge.codec.source import FgsSource
from flexgs_edge.codec.versions import file_version, open_fgs, read_header, verify
from flexgs_edge.scene.model import register_reader

__all__ = [
    "FgsSource",
    "GridSource",
    "channel_bytes",
    "coded_size",
    "file_version",
    "open_fgs",
    "read_header",
    "trim_container",
    "verify",
    "write_grid",
]

register_reader(".fgs", open_fgs)
