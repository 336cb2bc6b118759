"""Cameras: their files and photos, generated views, and orders of views."""
