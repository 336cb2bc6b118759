"""The OpenCL backend: build the kernels for one device, and launch them by name."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

import pyopencl as cl

from flexgs_edge.constants import LANES, ROW_SPAN
from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS
from flexgs_edge.kernels.choose_device import DeviceInfo
from flexgs_edge.kernels.cl_sources import load_source
from flexgs_edge.kernels.form import GPU_WIDTHS, WIDTHS, Form, likely_form, native_width
from flexgs_edge.kernels.session import Session
from flexgs_edge.memory.budget import MemoryBudget

LIMITED_BLOCKS = 16
"""Work-items of the serial passes. More would make the scans of their counts longer, which one work-item does."""
STEPS_A_PAIR = 24
"""Steps that a pair of splat and tile may take. A blend of the GPU form takes 17 where the compiler leaves its sums a loop;
`tile_count` takes 7.25: the splat, its row of tiles (1.25), the four block rows of that, the tile."""
_DIGITS = 2048
SCAN_GROUPS = (1024, 256, 64)  # Sizes of the work-group that scans on GPUs: the largest that the device allows
LIST_GROUP = 64  # Size of the work-groups that list pairs on GPUs
GPU_BLOCKS = (64, 256)
"""Least and most work-items of the serial passes on GPUs; between them, two for each compute unit."""


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


class OpenCLBackend(Session):
    """Kernels and memory of one OpenCL device."""

    is_numpy = False

    def __init__(
        self,
        info: DeviceInfo,  # the device
        budget: MemoryBudget,  # counts all buffers
        width: int | None = None,  # lanes of a vector: 16, 8, 4 or 1; in the GPU form 4 or 1
        form: str | None = None,  # form of the blend kernel: one work-item a tile, or one work-group a tile
        written_fma: bool | None = None,  # whether `fma` is written out
    ) -> None:
        start = time.perf_counter()
        super().__init__(info, budget)
        chosen = Form.named(info.form) or likely_form(info)
        if form is not None and form != chosen.kind:
            chosen = replace(chosen, kind=form, width=1 if form == "gpu" else native_width(info))
        self.form, self.width = chosen.kind, width or chosen.width
        self.written_fma = chosen.written_fma if written_fma is None else written_fma
        widths = GPU_WIDTHS if self.form == "gpu" else WIDTHS
        if self.width not in widths:
            expected = ", ".join(map(str, widths))
            raise DeviceError(f"vector width {self.width} of the {self.form} form: expected one of {expected}")
        self.name = f"{info.name} ({info.platform})"
        # OpenCL does not ask for rounded quotients and roots: docs/devices.md#quotients-and-roots
        offers = cl.device_fp_config.CORRECTLY_ROUNDED_DIVIDE_SQRT
        rounds = info.handle is not None and info.handle.single_fp_config & offers
        self._options = ("-cl-fp32-correctly-rounded-divide-sqrt",) if rounds else ()
        # Hints and conversions that are not OpenCL C: only PoCL's compiler is known to take them, and only it gains by them.
        self._builtins = "portable computing" in info.platform.lower()
        # Blocks of the serial passes: enough to keep all compute units busy, few enough for short scans.
        least, most = GPU_BLOCKS
        gpu_blocks = min(max(2 * info.compute_units, least), most)
        self.sort_blocks = self.tile_blocks = max(4 * info.compute_units, 16) if self.form == "cpu" else gpu_blocks
        self._scan_group = next((size for size in SCAN_GROUPS if size <= info.max_work_group), 1)
        self.most_pairs = 0
        if info.loop_steps:
            self.sort_blocks = self.tile_blocks = LIMITED_BLOCKS
            self.most_pairs = info.loop_steps // STEPS_A_PAIR
        # The codec's kernels take f64, and join two numbers in one of twice the width, which needs little endian.
        able = info.handle is not None and info.handle.double_fp_config != 0 and info.handle.endian_little
        self.threads = info.compute_units if self.form == "cpu" and able and not info.loop_steps else 0
        self._kernels: dict[str, cl.Kernel] = {}
        self.startup_seconds = time.perf_counter() - start

    def describe(self) -> dict[str, Any]:
        """The device and its settings, for `--json`."""
        return {"backend": "opencl", **self.info.to_json(), "width": self.width, "form": self.form}

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Enqueue the kernel `name` over `size` rows, items or tiles."""
        spec = KERNELS.get(name) or CODEC_KERNELS[name]
        if name not in self._kernels:
            options = [f"-DW={min(self.width, spec.widest)}", *self._options]
            if self.form == "gpu":
                options += [f"-DGROUP={self._scan_group}", f"-DLIST_GROUP={LIST_GROUP}"]
            if self.written_fma:
                options.append("-DWRITTEN_FMA")
            if self._builtins:
                options.append("-DCLANG_BUILTINS")
            source = load_source(spec.file.format(form=self.form), spec.stats, self.form)
            self._kernels[name] = self.kernel(source, name, tuple(options), spec.signature)
        local: tuple[int, ...] = (1,) * len(size)
        if spec.per == "span" and self.form == "cpu":
            size = (size[0] // ROW_SPAN,)
        elif spec.per in ("rows", "span"):
            # LANES // width vectors are a whole group in any array, on all devices.
            size, local = (size[0] // self.width,), (LANES // self.width,)
        elif spec.per == "tile" and self.form == "gpu":
            size, local = (size[0] * 256 // self.width,), (256 // self.width,)
        elif spec.per == "block" and self.form == "gpu":
            size, local = (size[0] * LIST_GROUP,), (LIST_GROUP,)
        elif spec.per == "group" and self.form == "gpu":
            size = local = (self._scan_group,)
        if self.info.loop_steps:
            check_steps(self.info, name, size, args)
        if size[0]:
            self.enqueue(name, self._kernels[name], size, local, args)
