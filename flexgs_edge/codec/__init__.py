"""The `.fgs` container: bytes only (docs/format.md). Importing it lets `open_scene` read `.fgs` files."""

from flexgs_edge.codec.source import FgsSource
from flexgs_edge.scene.model import register_reader

register_reader(".fgs", FgsSource)
