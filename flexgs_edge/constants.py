"""All numbers that kernels, twins and formats share, each with its reason and origin.

Every number is rounded to float32 once and printed into the OpenCL programs (`flexgs_edge.kernels.cl_sources`). A test
reads the values back from the device.
"""

import math
from typing import Final

# --- tiles and blocks -------------------------------------------------------------------------
TILE: Final = 16
"""Side of a tile in pixels, as in the reference rasteriser; a tile's list of splats then fits a core's L1 cache."""
BLOCK: Final = 4
"""Side of the 4x4 pixel blocks of a tile; a bit of a pair's 16-bit mask switches each block on or off. A vector of 16
lanes draws one block: small splats leave fewer lanes idle than rows of 16 pixels would."""
LANES: Final = 64
"""Planes on the device are padded to a multiple of this many elements. Vectors then never read past the end, and
work-groups of 64 fit a GPU."""
ROW_BLOCK: Final = 256
"""Rows of a block. A view skips the blocks that it cannot show, with all that is done for each row: a multiple of LANES,
so that vectors and work-groups stay within a block: docs/results/tuning.md#row_block"""
ROW_SPAN: Final = 128
"""Elements of a picture's row that one work-item of a processor has: whole vectors of any width, many more than a window
is wide, and few enough for the nearest cache: docs/results/tuning.md#one_pass"""
SUM_LANES: Final = 16
"""Sums over views lie in groups of so many rows, all planes of a group side by side. Planes of all rows would be more
streams than a processor fetches ahead: docs/results/tuning.md#sum_lanes"""

# --- projection (reference rasteriser) --------------------------------------------------------
DEFAULT_NEAR: Final = 0.2  # Near plane in scene units; Gaussians with a camera z <= near are culled
DILATION: Final = 0.3
"""Added to both diagonal terms of the 2D covariance, in px^2, so that no splat gets thinner than a pixel."""
SHARE_MIN: Final = 1.0 / 255.0**2
"""Smallest ratio det before / det after the dilation that can show: opacity is at most 1, and its factor is the square root.
The reference program floors the factor at 0.005 instead. That leaves splats of opacity above 0.784 at alpha 0.0039 to 0.005."""
FACTOR_MIN: Final = 1e-30
"""Rows of a covariance's factor with a squared length (scene units^2) below this count as zero."""
JACOBIAN_MARGIN: Final = 0.15
"""The Jacobian is taken at a point clamped to the image plus this share of its width (height) on each side. For a
centred principal point, that is 1.3 times the half field of view."""

# --- blending (reference rasteriser) ----------------------------------------------------------
ALPHA_MIN: Final = 1.0 / 255.0  # A splat with an alpha below one 8-bit step at a pixel is skipped there
ALPHA_MAX: Final = 0.99  # Largest alpha, so that no single splat brings the transmittance to zero
TRANSMITTANCE_MIN: Final = 1e-4
"""A splat that would bring the transmittance below this ends the pixel, and is not blended."""
LOG2_E: Final = math.log2(math.e)
LOG2_255: Final = math.log2(255.0)
LOG2_ALPHA_MIN: Final = -LOG2_255
"""We compare the exponent of a splat at a pixel, not its alpha. In float32, this is the least x with a computed 2^x of
ALPHA_MIN or more. For smaller x, 2^x is not used and need not be right."""
LOG2_ALPHA_MAX: Final = -0.0144997
"""Cap on the exponent, in place of alpha: the computed 2^x is ALPHA_MAX to the bit. For log2(ALPHA_MAX) it is an ulp more."""

# --- extents ----------------------------------------------------------------------------------
EXTENT_SLACK: Final = 4e-6
"""Added to the ellipse's level in log2 units. It covers the rounding of log2, exp2 and the exponent sum (each below
1e-6), so that no pixel with alpha >= 1/255 is left out."""
SPAN_SLACK: Final = 2e-3  # Pixels added to both ends of a block row's span: 16 ulp at pixel 2000
SPAN_SLACK_RELATIVE: Final = 2e-6  # Share of a span's own length that is added too: 16 roundings of the span's formula
MOST_NUMBERED: Final = 1 << 16
"""Splats of one tile keep its number beside its 16-bit mask, in pictures of at most so many tiles."""
CULLED: Final = 0xFFFFFFFF
"""Sort key of a Gaussian that the view does not show. These are the bits of a NaN, which no depth has."""

# --- spherical harmonics (real basis, the field's usual signs) --------------------------------
SH_C0: Final = 0.28209479177387814
SH_C1: Final = 0.4886025119029199
SH_C2: Final = (1.0925484305920792, -1.0925484305920792, 0.31539156525252005, -1.0925484305920792, 0.5462742152960396)
SH_C3: Final = (
    -0.5900435899266435, 2.890611442640554, -0.4570457994644658, 0.3731763325901154, -0.4570457994644658,
    1.445305721320277, -0.5900435899266435,
)  # fmt: skip
SH_C4: Final = (
    2.5033429417967046, -1.7701307697799304, 0.9461746957575601, -0.6690465435572892, 0.10578554691520431,
    -0.6690465435572892, 0.47308734787878004, -1.7701307697799304, 0.6258357354491761,
)  # fmt: skip
MAX_SH_DEGREE: Final = 4

# --- exp2 and log2 ----------------------------------------------------------------------------
EXP2_MAGIC: Final = 12582912.0  # 1.5 * 2^23: adding and subtracting it rounds a float32 to the nearest integer
EXP2_LOW: Final = -126.0
EXP2_HIGH: Final = 127.0  # Arguments of exp2 are clamped to this range, so that there are no denormals and no infinity
EXP2_POLY: Final = (1.000000072, 6.931469671e-1, 2.402211972e-1, 5.550713274e-2, 9.675541333e-3, 1.327647178e-3)
"""Polynomial of degree 5 on [-0.5, 0.5]: relative error 7.5e-8 in reals, 2.15e-7 in float32."""

LOG2_PIVOT: Final = 0x3F2AAAAB  # Bits of 2/3 as float32: log2 splits its argument into 2^e * m with m in [2/3, 4/3)
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
)  # log2(1 + f) = f * P(f) on f in [-1/3, 1/3): absolute error 7.1e-8 in float32 (our own Chebyshev fit)

DEQUANTIZE_ROWS: Final = 64
"""Rows of a work-item of the dequantize kernel: one division finds its group, and there are enough items for all units."""

# --- reductions -------------------------------------------------------------------------------
FIXED_WEIGHT: Final = 2.0**32
FIXED_ERROR: Final = 2.0**40
"""Units of the 64-bit fixed-point sums over tiles and views, of weights and of squared errors. Any order of additions gives the
same bits. The weight of a pixel is at most 1. Errors get finer units, since small splats decide what is pruned first."""
FIXED_MOMENT: Final = 2.0**26
"""Units of the gradient's moments about a splat's centre, in pixels and squared pixels. The sum wraps only beyond
1.3e11: a splat that fills an image of 2000 pixels a side, which lacks a tenth of its light everywhere."""
GRADIENT_MIN: Final = 1e-15
"""Gradients and their running means below this count as zero. Squares of smaller ones are not normal numbers, and
devices treat these differently."""
FIXED_LARGEST: Final = 2.0**62
"""Values are clamped to this before they become integers: the sum of one view, or of all tiles of a view."""

# --- similarity of images (Wang et al. 2004) ----------------------------------------------------
SSIM_SIGMA: Final = 1.5  # Standard deviation of the window, pixels
SSIM_WINDOW: Final = 11  # Side of the window in pixels, and so of the smallest picture with an SSIM
SSIM_C1: Final = 0.01**2
SSIM_C2: Final = 0.03**2  # Keeps the quotients of means and of variances finite, for a data range of 1

# --- difference of images as seen in alternation, LDR-FLIP (Andersson et al. 2020) ---------------
FLIP_DEGREE: Final = 0.7 * 3840 / 0.7 * math.pi / 180
"""Pixels per degree of the visual field, 67.02: a screen of 3840 pixels and 0.7 m, seen from 0.7 m, as NVIDIA's program
assumes."""
FLIP_WIDEST: Final = 0.04  # Width of the widest Gaussian of colours, exp(-(pi x)^2 / width) with x in degrees
FLIP_FEATURE: Final = 0.082  # Width of the filters of edges and points, degrees: two standard deviations
FLIP_REACH: Final = math.ceil(3 * math.sqrt(FLIP_WIDEST / (2 * math.pi**2)) * FLIP_DEGREE)
"""Pixels that the widest filter of colours reaches from its centre: three standard deviations."""
FLIP_FINE_REACH: Final = 6
"""Pixels that the filters of light and of red against green reach. Weights beyond are below 1e-7 of the sum."""
FLIP_FEATURE_REACH: Final = math.ceil(3 * 0.5 * FLIP_FEATURE * FLIP_DEGREE)
"""Pixels that the filters of edges and points reach."""
FLIP_XYZ: Final = (
    *(0.43388735, 0.37622401, 0.18988865),
    *(0.21263901, 0.71516868, 0.07219232),
    *(0.01775004, 0.10944762, 0.87280234),
)
"""Linear sRGB to CIE XYZ over that of white, row by row: from the chromaticities of IEC 61966-2-1, white (0.3127, 0.3290)."""
FLIP_RGB: Final = (
    *(3.08039909, -1.53738318, -0.54301591),
    *(-0.92122336, 1.8759675, 0.04525586),
    *(0.05287394, -0.20397696, 1.15110302),
)  # The inverse of `FLIP_XYZ`
FLIP_COLOUR_POWER: Final = 0.7
FLIP_COLOUR_MOST: Final = 41.27657  # Largest difference of colours, to `FLIP_COLOUR_POWER`: that of green and blue
FLIP_KNEE: Final = 0.4 * FLIP_COLOUR_MOST
FLIP_KNEE_SHARE: Final = 0.95  # Differences of colours below the knee take this share of the range from 0 to 1
FLIP_LEAST: Final = 1e-12
"""Smallest base of a power; the power of anything less is 0. Its cube is still a normal float32."""

# --- container version 2 ----------------------------------------------------------------------
RANS_PRECISION: Final = 14  # Probabilities are multiples of 1/2^14
RANS_TOTAL: Final = 1 << RANS_PRECISION  # Sum of the frequencies of a table
RANS_FLOOR: Final = 1 << 16  # Smallest state between symbols, and the first state of every lane
RANS_LANES: Final = 512  # Most lanes of a stream
LEVEL_CLASSES: Final = 6
"""Classes of octree levels by their distance from the cells. All coarser levels share the last class: they have few nodes."""
CHILD_CLASSES: Final = 5
"""Classes of octree nodes by the number of the parent's children: none (the root), 1, 2, 3, more."""
COARSE_ROWS: Final = 256  # Most rows of the first pass over a chunk; these rows have no neighbours yet
VALUE_LIMIT: Final = 16383.0  # Largest value in predictions: sums of 256 such values stay exact in float32
CODE_LIMIT: Final = 1 << 24  # Largest magnitude of a code: float32 holds all of them exactly

# --- method (FlexGaussian, ACM MM 2025) -------------------------------------------------------
VOLUME_POWER: Final = 0.1  # Exponent of the Gaussian's volume in the gs and meson scores
GROUP_ROWS: Final = 512  # Rows of a quantization group. The paper's 1000 groups take 528 kB for any number of rows.
DEFAULT_BASE_PSNR: Final = 34.0  # Assumed PSNR in dB of a model against its photos, for views whose photo cannot judge
DEFAULT_HOLDOUT: Final = 8  # Every 8th view by name is held out, the field's convention since Mip-NeRF 360
MAX_VIEW_WIDTH: Final = 1600  # Wider views are scaled down to this width, as in the reference training program
