"""Stay within the steps that some runtimes allow the loops of a work-item: docs/devices.md#loops-that-end."""

from __future__ import annotations

from typing import Any

from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.choose_device import DeviceInfo

LIMITED_BLOCKS = 16
"""Work-items of the serial passes. More would make the scans of their counts longer, which one work-item does."""
STEPS_A_PAIR = 24
"""Steps that a pair of splat and tile may take. A blend of the GPU form takes 17 where the compiler leaves its sums a loop;
`tile_count` takes 7.25: the splat, its row of tiles (1.25), the four block rows of that, the tile."""
_DIGITS = 2048


def steps_of(name: str, size: tuple[int, ...], args: tuple[Any, ...]) -> int:
    """Steps of the longest work-item of the passes whose steps grow with the scene or the view; 0 for other kernels."""
    if name == "exclusive_scan":
        cells, blocks = args[:2]
        # More than the scan of one work-group takes: a list has room for one pair a tile, and a blend takes all in one tile.
        return int(cells * (blocks + 2))
    if name.startswith("sort_"):
        return int(args[0] // size[0] + _DIGITS)
    return 0


def check_steps(info: DeviceInfo, name: str, size: tuple[int, ...], args: tuple[Any, ...]) -> None:
    """Refuse a launch whose loops the device would leave early, since its results would be wrong.

    Raises `DeviceError` with what to do.
    """
    steps = steps_of(name, size, args)
    if steps > info.loop_steps:
        what = "views of fewer pixels" if name == "exclusive_scan" and args[0] != _DIGITS else "a smaller scene"
        raise DeviceError(
            f"{info.name} ({info.platform}) leaves loops after {info.loop_steps} steps, and {name} needs {steps}: "
            f"use another device, or {what}"
        )
