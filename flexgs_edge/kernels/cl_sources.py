"""Assemble OpenCL programs: shared constants, `common.clh`, the other `.clh` helpers, and the file of the kernel."""

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from flexgs_edge import constants
from flexgs_edge.errors import DeviceError
from flexgs_edge.kernels.backend import KERNELS

KERNEL_DIR_VARIABLE = "FLEXGS_KERNEL_DIR"
"""Environment variable with another kernel folder. Tests plant faults in a copy, and expect checks to notice."""

_COMMON = "common.clh"
# Files of helpers that come before every kernel file
_SHARED = (_COMMON, "sh.clh", "activate.clh", "values.clh", "spans.clh")
_TOGETHER = ("activate.cl", "project.cl", "sort.cl", "score.cl", "similarity.cl", "flip.cl")
_CODEC = ("chunk_streams.clh", "chunk_passes.clh", "code_chunks.cl", "encode_chunks.cl")
"""Files that together make one program of the codec."""
_BLENDS = {spec.stats: name for name, spec in KERNELS.items() if spec.stats is not None}
"""Blend kernels by their kind of statistics, STATS; one file makes all of them."""
_BLENDS_TOGETHER = (0, 2, 3, 4)
"""Blends that make one program together, since each program takes time to load and to build, however small it is:
docs/results/tuning.md#programs"""


def kernel_dir() -> Path:
    """The folder of the `.cl` files.

    The order is: the folder that FLEXGS_KERNEL_DIR names; `cl_kernels` inside the installed package (a wheel puts it
    there); `cl_kernels` beside the package (a checkout, an unpacked sdist, an editable install).

    Raises `DeviceError` if that folder holds no `common.clh`.
    """
    override = os.environ.get(KERNEL_DIR_VARIABLE)
    package = Path(__file__).resolve().parents[1]
    candidates = [Path(override)] if override else [package / "cl_kernels", package.parent / "cl_kernels"]
    for candidate in candidates:
        if (candidate / _COMMON).is_file():
            return candidate
    places = " or ".join(str(candidate) for candidate in candidates)
    advice = f"correct or unset {KERNEL_DIR_VARIABLE}" if override else "install flexgs-edge again"
    raise DeviceError(f"OpenCL sources: expected {_COMMON} in {places}, found none: {advice}")


def float_literal(value: float) -> str:
    """A float32 as OpenCL C text that reads back to the same bits.

    `value` is rounded to float32 here, once; nine significant digits suffice for any float32.

    >>> float_literal(0.3), float_literal(-126.0), float_literal(2.0**62)
    ('0.300000012f', '(-126.0f)', '4.61168602e+18f')
    """
    text = f"{float(np.float32(value)):.9g}"
    if "." not in text and "e" not in text:
        text += ".0"
    return _signed(f"{text}f")


def integer_literal(value: int) -> str:
    """An integer as OpenCL C text: an `int` if it fits, else a `uint`.

    >>> integer_literal(16), integer_literal(0xFFFFFFFF)
    ('16', '4294967295u')
    """
    if not -(2**31) <= value < 2**32:
        raise ValueError(f"constant {value}: expected an int or uint of 32 bits")
    return _signed(f"{value}u" if value >= 2**31 else str(value))


def _signed(text: str) -> str:
    return f"({text})" if text.startswith("-") else text


def shared_constants() -> Iterator[tuple[str, int | float]]:
    """Yield name and value of every number in `flexgs_edge.constants`, in order. A tuple gives `NAME_0`, `NAME_1`, ..."""
    for name, value in vars(constants).items():
        if not name.isupper():
            continue
        if isinstance(value, tuple):
            yield from ((f"{name}_{i}", element) for i, element in enumerate(value))
        elif isinstance(value, (int, float)):
            yield name, value


def constants_header() -> str:
    """`flexgs_edge.constants` as `#define` lines: float32 literals for floats, int or uint literals for integers."""
    return "".join(
        f"#define {name} {integer_literal(value) if isinstance(value, int) else float_literal(value)}\n"
        for name, value in shared_constants()
    )


def load_source(name: str, stats: int | None = None, form: str = "cpu") -> str:
    """The program text of a kernel file: all `.clh` helpers (`common.clh` first), then the kernels.

    `#line` directives make the compiler name files and lines that a person can open.

    Raises `DeviceError` if the folder or the file is missing.
    """
    folder = kernel_dir()
    parts = ['#line 1 "constants.py, as printed by flexgs_edge.kernels.cl_sources"\n', constants_header()]
    pieces: list[tuple[str, int | None]] = [(file, None) for file in _SHARED]
    if name in _TOGETHER or stats in _BLENDS_TOGETHER:
        pieces += [(file, None) for file in _TOGETHER] + [(f"blend_{form}.cl", kind) for kind in _BLENDS_TOGETHER]
    else:
        pieces += [(file, stats) for file in (_CODEC if name in _CODEC else (name,))]
    for file, kind in pieces:
        if kind is not None:
            parts.append(f"#undef STATS\n#undef BLEND\n#define STATS {kind}\n#define BLEND {_BLENDS[kind]}\n")
        try:
            text = (folder / file).read_text(encoding="utf-8")
        except OSError as error:
            raise DeviceError(f"OpenCL source {folder / file}: {error.strerror}; install flexgs-edge again") from error
        parts.append(f'#line 1 "{file}"\n{text}\n')
    return "".join(parts)
