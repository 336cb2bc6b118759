"""Compression into formats of other programs: `.spz`, `.sog`, `.compressed.ply`."""
