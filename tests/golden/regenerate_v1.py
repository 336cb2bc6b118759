"""Write tests/golden/v1 anew. Only for a deliberate change of the format, together with a new version number.

python tests/golden/regenerate_v1.py
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from flexgs_edge.codec.v1.container import write_container
from flexgs_edge.codec.v1.packed_source import FgsSource
from flexgs_edge.packed.bitpack import BitSpec
from flexgs_edge.packed.quantize import quantize_scene
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import MemorySource, SceneSource

FOLDER = Path(__file__).parent / "v1"
BITS = BitSpec(xyz=16, dc=8, scale=7, rot=9, opacity=4, rest=3)
SETTINGS = {"method": "paper", "near": 0.2, "text": "\u00e9"}
ROWS_WITH_SH = np.array([1, 4, 5, 9, 10])
ROWS_WITHOUT_SH = np.array([0, 2, 3, 7, 8, 12])


def golden_scene() -> SceneSource:
    """13 rows of simple fractions: no generator of random numbers has to stay the same."""
    arrays = {}
    for field in FIELDS:
        width = field.width(1)
        index = np.arange(13 * width).reshape(width, 13)
        arrays[field.name] = ((index * 37 % 101 - 50) / 16 + 0.03125).astype(np.float32)
    return MemorySource(arrays, origin=(0.1, -2.0, 1e6))


def main(folder: Path = FOLDER) -> None:
    quantized = quantize_scene(golden_scene(), ROWS_WITH_SH, ROWS_WITHOUT_SH, BITS, 2)
    folder.mkdir(exist_ok=True)
    write_container(folder / "tiny.fgs", quantized, SETTINGS, force=True)
    source = FgsSource(folder / "tiny.fgs")
    np.savez(folder / "tiny.npz", **source.read(slice(0, source.count), [field.name for field in FIELDS]))


if __name__ == "__main__":
    sys.exit(main())
