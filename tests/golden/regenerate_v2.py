"""Write tests/golden/v2 anew. Only for a deliberate change of the format, together with a new version number.

python tests/golden/regenerate_v2.py

`early.fgs` is what writers made before headers said what the channels take: readers keep reading it.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.grid.grid_scene import GridScene
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.scene.fields import FIELDS

FOLDER = Path(__file__).parent / "v2"
SETTINGS = {"method": "best", "near": 0.2, "text": "\u00e9"}


def golden_grid() -> GridScene:
    """400 rows of simple fractions in two layers: no generator of random numbers has to stay the same."""
    planes = {}
    for field in FIELDS:
        width = field.width(2)
        index = np.arange(400 * width).reshape(width, 400)
        planes[field.name] = ((index * index * 37 % 101 - 50) / 16 + 0.03125).astype(np.float32)
    planes["opacity_logits"][0, 5] = 1e5  # an escape
    planes["means"][:, 7] = planes["means"][:, 8]  # a repeat
    degrees, layer = np.arange(400) // 7 % 3, np.arange(400) % 2
    return to_grid(planes, degrees, StepSizes(0.125, 0.25, 0.0625, 0.5, 0.125, (0.25, 0.5)), (0.1, -2.0, 1e6), layer)[0]


def main(folder: Path = FOLDER) -> None:
    folder.mkdir(exist_ok=True)
    write_grid(folder / "tiny.fgs", golden_grid(), SETTINGS, force=True, chunk_rows=128)
    source = GridSource(folder / "tiny.fgs")
    np.savez_compressed(folder / "tiny.npz", **source.read(slice(0, source.count), [field.name for field in FIELDS]))


if __name__ == "__main__":
    sys.exit(main())
