"""NumPy twins of the OpenCL kernels: the same names, the same arguments after the launch size, and the same bits.

The twins are the specification of the kernels. `--device numpy` runs them; they are far slower.
"""

from __future__ import annotations

from collections.abc import Callable

from flexgs_edge.kernels.twins.activate import activate
from flexgs_edge.kernels.twins.backward import project_backward
from flexgs_edge.kernels.twins.blend import (
    blend,
    blend_backward,
    blend_both,
    blend_removal,
    blend_residual,
    blend_stats,
)
from flexgs_edge.kernels.twins.dequantize import dequantize
from flexgs_edge.kernels.twins.descend import descend, follow, snap
from flexgs_edge.kernels.twins.flip import flip_colours, flip_columns, flip_pair, flip_rows
from flexgs_edge.kernels.twins.project import project
from flexgs_edge.kernels.twins.score import add_costs, residual, sh_residual
from flexgs_edge.kernels.twins.similarity import dssim_residual, dssim_slopes, ssim_columns, ssim_rows
from flexgs_edge.kernels.twins.sort import (
    exclusive_scan,
    sort_count,
    sort_count_first,
    sort_scatter,
    sort_scatter_first,
)
from flexgs_edge.kernels.twins.tiles import tile_count, tile_room, tile_scatter

TWINS: dict[str, Callable[..., None]] = {
    "activate": activate,
    "project": project,
    "sort_count_first": sort_count_first,
    "sort_scatter_first": sort_scatter_first,
    "sort_count": sort_count,
    "sort_scatter": sort_scatter,
    "exclusive_scan": exclusive_scan,
    "tile_room": tile_room,
    "tile_count": tile_count,
    "tile_scatter": tile_scatter,
    "blend": blend,
    "blend_stats": blend_stats,
    "blend_removal": blend_removal,
    "blend_residual": blend_residual,
    "blend_both": blend_both,
    "blend_backward": blend_backward,
    "residual": residual,
    "ssim_columns": ssim_columns,
    "ssim_rows": ssim_rows,
    "flip_colours": flip_colours,
    "flip_columns": flip_columns,
    "flip_rows": flip_rows,
    "flip_pair": flip_pair,
    "dssim_slopes": dssim_slopes,
    "dssim_residual": dssim_residual,
    "add_costs": add_costs,
    "sh_residual": sh_residual,
    "project_backward": project_backward,
    "descend": descend,
    "follow": follow,
    "snap": snap,
    "dequantize": dequantize,
}
