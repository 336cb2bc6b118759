"""NumPy twins of the OpenCL kernels: the same names, the same arguments after the launch size, and the same bits.

The twins are the specification of the kernels. `--device numpy` runs them; they are far slower.
"""

from collections.abc import Callable
from importlib import import_module

from flexgs_edge.kernels.backend import KERNELS

# The twins of a kernel file lie in the module of its name; forms of a kernel share one.
_MODULES = {name: spec.file.removesuffix(".cl").removesuffix("_{form}") for name, spec in KERNELS.items()}
TWINS: dict[str, Callable[..., None]] = {
    name: getattr(import_module(f"{__name__}.{module}"), name) for name, module in _MODULES.items()
}
