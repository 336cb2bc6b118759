"""NumPy twins of the OpenCL kernels: the same names, the same arguments after the launch size, and the same bits.

The twins are the specification of the kernels. `--device numpy` runs them; they are far slower.
"""

from collections.abc import Callable

from flexgs_edge.kernels.backend import KERNELS
from flexgs_edge.kernels.twins import (
    activate,
    backward,
    blend,
    dequantize,
    descend,
    flip,
    project,
    score,
    similarity,
    sort,
    tiles,
)

_FILES = (activate, backward, blend, dequantize, descend, flip, project, score, similarity, sort, tiles)
TWINS: dict[str, Callable[..., None]] = {
    name: getattr(file, name) for file in _FILES for name in KERNELS if hasattr(file, name)
}
