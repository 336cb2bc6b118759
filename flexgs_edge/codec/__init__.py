"""The `.fgs` container format, versions 1 and 2: bytes in and out, no rendering (docs/format.md)."""
