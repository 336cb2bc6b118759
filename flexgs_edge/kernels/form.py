"""Forms of the kernels: the same bits by other work-items. Which one is fastest is measured: docs/devices.md#forms."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

from flexgs_edge.kernels.choose_device import DeviceInfo

WIDTHS = (16, 8, 4, 1)  # Lanes that a vector may have
GPU_WIDTHS = (1, 4)
"""Pixels of a work-item of the GPU form. With 8, llvmpipe was no faster, and took four times as long to build."""


@dataclass(frozen=True)
class Form:
    """One form of the kernels."""

    kind: str  # a tile is blended by one work-item, or by one work-group
    width: int  # lanes of a vector
    written_fma: bool = False  # whether `fma` is written out in `common.clh`, for devices whose own one is slow

    def __str__(self) -> str:
        return f"{self.kind}{self.width}{'+fma' if self.written_fma else ''}"

    @classmethod
    def named(cls, name: str) -> Form | None:
        """The form that has this name; None if none has.

        >>> Form.named("gpu4+fma"), Form.named("tpu")
        (Form(kind='gpu', width=4, written_fma=True), None)
        """
        match = re.fullmatch(r"(cpu|gpu)(16|8|4|1)(\+fma)?", name)
        return cls(match[1], int(match[2]), match[3] is not None) if match else None


def native_width(info: DeviceInfo) -> int:
    """Lanes of the device's own vectors."""
    return max(width for width in WIDTHS if width <= max(info.native_width, 1))


def likely_form(info: DeviceInfo) -> Form:
    """The form for a device of which nothing was measured: it follows the type."""
    # A pixel takes fewer steps than a tile, so the GPU form serves devices that end loops.
    return Form("gpu", 1) if info.type == "gpu" or info.loop_steps else Form("cpu", native_width(info))


def possible_forms(info: DeviceInfo) -> list[Form]:
    """Forms that the device can take, the likely one first, without those that write out `fma`."""
    forms = [Form("gpu", width) for width in GPU_WIDTHS if 256 // width <= info.max_work_group]
    if not info.loop_steps:
        forms.append(Form("cpu", native_width(info)))
    return sorted(forms, key=lambda form: form != likely_form(info))


def with_written_fma(form: Form) -> Form:
    """`form` with `fma` written out."""
    return replace(form, written_fma=True)
