"""Fixtures that tests of readers and writers share."""

from __future__ import annotations

import pytest

from gltf_files import GltfBuilder


@pytest.fixture
def builder() -> GltfBuilder:
    """A glTF file in the making."""
    return GltfBuilder()
