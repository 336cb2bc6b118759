"""Our own files: the `.fgs` container, bytes only (docs/format.md)."""
