"""Every number that kernels, twins and formats share, once, with its reason and origin.

Every number is printed into the OpenCL programs, rounded to float32 once (`flexgs_edge.kernels.cl_sources`), and a test reads the
values back from the device.
"""

from __future__ import annotations

import math
from typing import Final

# --- tiles and blocks -------------------------------------------------------------------------
TILE: Final = 16
"""Tile side in pixels (the reference rasteriser's; a tile's splat list then fits a core's L1)."""
BLOCK: Final = 4
"""Side of the 4x4 pixel blocks inside a tile that a pair's 16-bit mask switches on and off. A vector of
16 lanes is one block: small splats leave fewer idle lanes than with rows of 16."""
LANES: Final = 64
"""Planes on the device are padded to a multiple of this many elements: vectors never read past the end, and a GPU's
work-groups of 64 fit."""

# --- projection (reference rasteriser) --------------------------------------------------------
DEFAULT_NEAR: Final = 0.2
"""Near plane in scene units; Gaussians with camera z <= near are culled."""
DILATION: Final = 0.3
"""Added to both diagonal terms of the 2D covariance, in px^2: a splat never gets thinner than a pixel."""
SHARE_MIN: Final = 1.0 / 255.0**2
"""Smallest det before / det after the dilation that can show: opacity is at most 1, and its factor is the square root. The
reference program floors the factor at 0.005 instead, which leaves splats of opacity above 0.784 at alpha 0.0039 to 0.005."""
FACTOR_MIN: Final = 1e-30
"""Rows of a covariance's factor whose squared length (scene units^2) is below this count as zero."""
JACOBIAN_MARGIN: Final = 0.15
"""The Jacobian is taken at a point clamped to the image plus this share of its width (height) on each side:
1.3 times the half field of view for a centred principal point."""
SIGMA_RADIUS_INRIA: Final = 3.0
"""Extent of `--extent inria`: ceil(3 sigma), rounded out to whole tiles."""

# --- blending (reference rasteriser) ----------------------------------------------------------
ALPHA_MIN: Final = 1.0 / 255.0
"""A splat whose alpha is below one 8-bit step at a pixel is skipped there."""
ALPHA_MAX: Final = 0.99
"""Alpha is capped, so that transmittance never gets to zero in one step."""
TRANSMITTANCE_MIN: Final = 1e-4
"""The splat that would bring transmittance below this ends the pixel and is not blended."""
LOG2_E: Final = math.log2(math.e)
LOG2_255: Final = math.log2(255.0)
LOG2_ALPHA_MIN: Final = -LOG2_255
"""The exponent of a splat at a pixel is compared, not its alpha: as float32 this is the least x whose 2^x, as computed, is
ALPHA_MIN or more. Below it 2^x is not used, and need not be right."""
LOG2_ALPHA_MAX: Final = -0.0144997
"""The exponent is capped, not alpha: 2^x of this, as computed, is ALPHA_MAX to the bit (of log2(ALPHA_MAX) it is an ulp more)."""

# --- extents ----------------------------------------------------------------------------------
EXTENT_SLACK: Final = 4e-6
"""Added to the ellipse's level in log2 units: covers the rounding of log2, exp2 and the exponent sum (each
below 1e-6), so that no pixel with alpha >= 1/255 is left out."""
SPAN_SLACK: Final = 2e-3
"""Pixels added to both ends of a block row's span: 16 ulp at pixel 2000."""
SPAN_SLACK_RELATIVE: Final = 2e-6
"""Share of a span's own length added as well: 16 roundings of the span's formula."""
CULLED: Final = 0xFFFFFFFF
"""Sort key of a Gaussian that the view does not show (the bits of a NaN: no depth has them)."""

# --- spherical harmonics (real basis, the field's usual signs) --------------------------------
SH_C0: Final = 0.28209479177387814
SH_C1: Final = 0.4886025119029199
SH_C2: Final = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
SH_C3: Final = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)
SH_C4: Final = (
    2.5033429417967046,
    -1.7701307697799304,
    0.9461746957575601,
    -0.6690465435572892,
    0.10578554691520431,
    -0.6690465435572892,
    0.47308734787878004,
    -1.7701307697799304,
    0.6258357354491761,
)
MAX_SH_DEGREE: Final = 4

# --- exp2 and log2 ----------------------------------------------------------------------------
EXP2_MAGIC: Final = 12582912.0
"""1.5 * 2^23: adding and taking it away rounds a float32 to the nearest integer."""
EXP2_LOW: Final = -126.0
EXP2_HIGH: Final = 127.0
"""exp2 arguments are clamped to this range: no denormals, no infinity."""
EXP2_POLY: Final = (
    1.000000072,
    6.931469671e-1,
    2.402211972e-1,
    5.550713274e-2,
    9.675541333e-3,
    1.327647178e-3,
)
"""Degree 5 on [-0.5, 0.5]: relative error 7.5e-8 in reals, 2.15e-7 in float32."""

LOG2_PIVOT: Final = 0x3F2AAAAB
"""Bits of 2/3 as float32: log2 splits its argument into 2^e * m with m in [2/3, 4/3)."""
LOG2_POLY: Final = (
    1.4426950216293335,
    -0.7213465571403503,
    0.4808958172798157,
    -0.36078956723213196,
    0.2887182831764221,
    -0.2367866337299347,
    0.20169900357723236,
    -0.2222205549478531,
    0.20323719084262848,
)
"""log2(1 + f) = f * P(f) on f in [-1/3, 1/3): absolute error 7.1e-8 in float32 (Chebyshev fit, ours)."""

DEQUANTIZE_ROWS: Final = 64
"""Rows of a work-item of the dequantize kernel: one division to find its group, few enough to spread over all units."""

# --- reductions -------------------------------------------------------------------------------
FIXED_WEIGHT: Final = 2.0**32
FIXED_ERROR: Final = 2.0**40
"""Units of the 64-bit fixed-point sums over tiles and views, of weights and of squared errors: any order of adding gives the
same bits. A pixel's weight is at most 1; errors get finer units since those of small splats decide what goes first."""
FIXED_MOMENT: Final = 2.0**26
"""The same for the gradient's moments about a splat's centre, in pixels and squared pixels: a splat may fill an
image of 2000 pixels a side that lacks a tenth of its light everywhere (1.3e11) before the sum wraps."""
GRADIENT_MIN: Final = 1e-15
"""Gradients and their running means below this count as zero: squares of smaller ones leave the normal numbers, where devices
differ."""
FIXED_LARGEST: Final = 2.0**62
"""Values are clamped to this before they become integers: what a view adds, or all tiles of a view together."""

# --- similarity of images (Wang et al. 2004) ----------------------------------------------------
SSIM_SIGMA: Final = 1.5
"""Standard deviation of the window, pixels."""
SSIM_WINDOW: Final = 11
"""Side of the window, and so of the smallest picture that has an SSIM."""
SSIM_C1: Final = 0.01**2
SSIM_C2: Final = 0.03**2
"""What keeps the quotients of means and of variances finite, for a data range of 1."""

# --- container version 2 ----------------------------------------------------------------------
RANS_PRECISION: Final = 14
"""Probabilities count in 1/2^14."""
RANS_TOTAL: Final = 1 << RANS_PRECISION
"""Frequencies of a table add up to this."""
RANS_FLOOR: Final = 1 << 16
"""Smallest state between symbols, and the first state of every lane."""
RANS_LANES: Final = 512
"""Lanes of a stream at most."""
LEVEL_CLASSES: Final = 6
"""Octree levels by their distance from the cells; all coarser ones count as the last: they have few nodes."""
CHILD_CLASSES: Final = 5
"""Octree nodes by how many children the parent has: none (the root), 1, 2, 3, more."""
COARSE_ROWS: Final = 256
"""The first pass over a chunk has at most this many rows; they have no neighbours yet."""
VALUE_LIMIT: Final = 16383.0
"""Values count as at most this large in predictions: sums of 256 of them stay exact in float32."""
CODE_LIMIT: Final = 1 << 24
"""Codes lie within +-this: float32 holds all of them exactly."""

# --- method (FlexGaussian, ACM MM 2025) -------------------------------------------------------
VOLUME_POWER: Final = 0.1
"""Exponent of the Gaussian's volume in the gs and meson scores."""
GROUP_ROWS: Final = 512
"""Rows per quantization group. The paper's 1000 groups weigh 528 kB whatever N is."""
DEFAULT_BASE_PSNR: Final = 34.0
"""PSNR of a model against its photos when there are none (dB). It is cautious: most models have less, and lose less. A
higher value can put the target out of reach, a lower one loses too much of a good model:
docs/results/tuning.md#default_base_psnr"""
DEFAULT_HOLDOUT: Final = 8
"""Every 8th view by name is held out: the field's convention since Mip-NeRF 360."""
MAX_VIEW_WIDTH: Final = 1600
"""Views wider than this are scaled down, as the reference training program does."""
