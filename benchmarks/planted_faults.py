"""Faults for mutation testing: each one is a text to replace in a kernel, and the tests that must see it."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Tests:
    """Files and keywords of the tests that must see a kind of fault. `{form}` stands for the form's name."""

    reference: tuple[str, ...]
    reference_words: str
    twins: tuple[str, ...]
    twin_words: str
    golden: bool = False


RENDER = Tests(
    (
        "tests/render/test_render_reference.py",
        "tests/methods/paper/test_scores.py",
        "tests/kernels/test_kernels_dequantize.py",
    ),
    "{form}",
    ("tests/kernels/test_kernels_twins.py", "tests/kernels/test_kernels_arithmetic.py"),
    "{form}",
    golden=True,
)
BACKWARD = Tests(
    ("tests/kernels/test_backward.py",), "float64", ("tests/kernels/test_backward.py",), "descents and {form}"
)
SIMILARITY = Tests(("tests/quality/test_ssim.py",), "scikit", ("tests/quality/test_ssim.py",), "scikit")
FLIP = Tests(("tests/quality/test_flip.py",), "gave", ("tests/quality/test_flip.py",), "gave")
STRUCTURE = Tests(
    ("tests/render/test_residual.py",), "gradient_of_ssim", ("tests/render/test_residual.py",), "twins and {form}"
)
COSTS = Tests(
    ("tests/methods/best/test_costs.py",),
    "exact or variance or alone or 64_bits",
    ("tests/methods/best/test_costs.py",),
    "every_form or 64_bits",
)
REFIT = Tests(
    ("tests/methods/best/test_refit.py",),
    "closer or lone_splat or optimum",
    ("tests/methods/best/test_refit.py",),
    "on_every_form",
)
ROWS = Tests((), "", ("tests/codec/v2/test_codec_kernel.py",), "source_on_a_device")
CODER = Tests((), "", ("tests/codec/v2/test_codec_kernel.py",), "same and {form}")
GOLDEN = ("tests/render/test_golden_fox.py",)


@dataclass(frozen=True)
class Mutation:
    """One fault.

    Parameters
    ----------
    name : str
        The fault in words, for the table.
    file : str
        The kernel file.
    old, new : str
        Text to replace everywhere in the file. It must occur.
    form : str
        Form of the kernels that the tests run on: `w16` or `gpu`.
    reference : bool
        Whether the reference can see it. Some faults only break the equality of bits between forms.
    tests : Tests
        Tests that must see it.
    """

    name: str
    file: str
    old: str
    new: str
    form: str = "w16"
    reference: bool = True
    tests: Tests = RENDER


def backward(
    name: str, old: str, new: str, file: str = "backward.cl", form: str = "w16", reference: bool = True
) -> Mutation:
    """A fault in gradients or in the descent along them."""
    return Mutation(name, file, old, new, form, reference, BACKWARD)


def structure(name: str, old: str, new: str) -> Mutation:
    """A fault in the gradient of SSIM."""
    return Mutation(name, "similarity.cl", old, new, tests=STRUCTURE)


def costs(name: str, old: str, new: str, file: str = "score.cl", form: str = "w16", reference: bool = True) -> Mutation:
    """A fault in costs of removal, or of dropping SH."""
    return Mutation(name, file, old, new, form, reference, COSTS)


def coder(name: str, old: str, new: str, file: str) -> Mutation:
    """A fault in the entropy coder."""
    return Mutation(name, file, old, new, reference=False, tests=CODER)


def rows(name: str, old: str, new: str) -> Mutation:
    """A fault in the rows that are computed from codes."""
    return Mutation(name, "grid_rows.cl", old, new, reference=False, tests=ROWS)


def constant(name: str, literal: str, words: str) -> Mutation:
    """A wrong constant, defined again in front of everything else."""
    first_line = "#pragma OPENCL FP_CONTRACT OFF\n"
    return Mutation(words, "common.clh", first_line, f"{first_line}#undef {name}\n#define {name} {literal}\n")


MUTATIONS = (
    Mutation("sign of the conic's B", "project.cl", "out[3] = -(b + b) * k", "out[3] = (b + b) * k"),
    Mutation("sign of the span's slope", "project.cl", "out[11] = b * ic", "out[11] = -b * ic"),
    Mutation("sign of where the ellipse turns", "project.cl", "out[9] = quotient(b, a)", "out[9] = -quotient(b, a)"),
    Mutation("half width from the wrong axis", "project.cl", "half_width = sqrt(t2 * a)", "half_width = sqrt(t2 * c)"),
    Mutation("no +0.3", "project.cl", "CAM(26)", "(FW)0.0f"),
    Mutation("+0.25 for +0.3", "project.cl", "CAM(26)", "(FW)0.25f"),
    constant("LOG2_ALPHA_MAX", "0.0f", "no cap of alpha at 0.99"),
    constant("LOG2_ALPHA_MAX", "-0.0291463f", "cap of alpha at 0.98"),
    constant("LOG2_ALPHA_MIN", "-8.0f", "1/256 for 1/255"),
    constant("LOG2_ALPHA_MIN", "-7.9657843f", "1/250 for 1/255"),
    constant("TRANSMITTANCE_MIN", "1e-3f", "pixels end at 1e-3"),
    constant("TRANSMITTANCE_MIN", "1e-5f", "pixels end at 1e-5"),
    constant("EXTENT_SLACK", "-0.01f", "ellipse too small"),
    constant("EXP2_POLY_5", "0.0f", "exp2 of degree 4"),
    Mutation("no Jacobian clamp in x", "project.cl", "uc = smaller(larger(u, CAM(17)), CAM(18))", "uc = u"),
    Mutation("no Jacobian clamp in y", "project.cl", "vc = smaller(larger(v, CAM(19)), CAM(20))", "vc = v"),
    Mutation(
        "clamp moved by half a pixel", "project.cl", "larger(u, CAM(17))", "larger(u, CAM(17) + (FW)0.5f / CAM(12))"
    ),
    Mutation("principal point off by half a pixel", "project.cl", "u, CAM(14))", "u, CAM(14) + (FW)0.5f)"),
    Mutation("focal length of x used for y", "project.cl", "fma(CAM(13), v", "fma(CAM(12), v"),
    Mutation("sign in SH of degree 1", "sh.clh", "BAND(0, (FW)-SH_C1 * y)", "BAND(0, (FW)SH_C1 * y)"),
    Mutation("sign in SH of degree 3", "sh.clh", "BAND(11, (FW)SH_C3_3", "BAND(11, (FW)-SH_C3_3"),
    Mutation(
        "SH looked up in the opposite direction", "sh.clh", "dx = px - (FW)camera[21]", "dx = (FW)camera[21] - px"
    ),
    Mutation("colours below 0 kept", "project.cl", "= larger(colour + (FW)0.5f, (FW)0.0f)", "= colour + (FW)0.5f"),
    Mutation("depth order reversed", "project.cl", "as_uint(key_lanes[l]) :", "~as_uint(key_lanes[l]) :"),
    Mutation(
        "ties of depth in reversed order",
        "sort.cl",
        "for (uint i = start; i < end; ++i) {\n    const uint key = keys[i];\n    if",
        "for (uint j = start; j < end; ++j) {\n    const uint i = end - 1 - (j - start);\n    const uint key = keys[i];\n    if",
    ),
    Mutation("no near plane", "project.cl", "MASK(z > CAM(16))", "MASK(z > (FW)0.0f)"),
    Mutation("near plane itself is drawn", "project.cl", "MASK(z > CAM(16))", "MASK(z >= CAM(16))"),
    Mutation("no opacity cull", "activate.clh", "pick(MASK(opacity >= (FW)ALPHA_MIN), level, (FW)-INFINITY)", "level"),
    Mutation(
        "quaternions not normalised",
        "activate.clh",
        "inv = quotient((FW)1.0f, sqrt(fma(z, z, fma(y, y, fma(x, x, w * w)))))",
        "inv = (FW)1.0f",
    ),
    Mutation("opacity not compensated", "project.cl", "level = fma((FW)0.5f, flog2(", "level = fma((FW)0.0f, flog2("),
    Mutation(
        "compensation by the area's ratio, not its root", "project.cl", "fma((FW)0.5f, flog2(", "fma((FW)1.0f, flog2("
    ),
    Mutation("sign in the area before dilation", "project.cl", "nz = fma(g00, g11, -(", "nz = fma(g00, g11, ("),
    Mutation("factor's rows not made orthogonal", "activate.clh", "m20 = fma(-yz, ux, m20)", "m20 = m20"),
    Mutation("determinant not checked", "project.cl", "MASK(det < (FW)INFINITY)", "MASK(det == det)"),
    Mutation("hit counted on the splat that ends", "common.clh", "return hit;", "return seen & MASK(t > (FW)0.0f);"),
    Mutation("ended pixels go on", "common.clh", "pick(seen, -fabs(t), t)", "t"),
    Mutation(
        "the splat that ends is blended",
        "common.clh",
        "hit = seen & MASK(next >= (FW)TRANSMITTANCE_MIN)",
        "hit = seen & MASK(t > (FW)0.0f)",
    ),
    Mutation(
        "background without transmittance",
        "blend_cpu.cl",
        "fma(t, (FW)background_g, green[k])",
        "green[k] + (FW)background_g",
    ),
    Mutation("no background", "blend_cpu.cl", "fma(t, (FW)background_r, red[k])", "red[k]"),
    Mutation(
        "fused multiply-add in dequantize", "dequantize.cl", "lo + (float)plane[i] * by", "fma((float)plane[i], by, lo)"
    ),
    Mutation(
        "fused multiply-add in dequantize, odd widths",
        "dequantize.cl",
        "lo + (float)((window >> (bit & 7)) & keep) * by",
        "fma((float)((window >> (bit & 7)) & keep), by, lo)",
    ),
    Mutation(
        "groups one row too long",
        "dequantize.cl",
        "(uint)((group + 1) * count / groups))",
        "(uint)((group + 1) * count / groups) + 1)",
    ),
    Mutation("contraction left to the compiler", "common.clh", "#pragma OPENCL FP_CONTRACT OFF\n", ""),
    Mutation(
        "sums in another order",
        "blend_cpu.cl",
        "(f.s0 + f.s2) + (f.s1 + f.s3)",
        "(f.s0 + f.s1) + (f.s2 + f.s3)",
        reference=False,
    ),
    Mutation(
        "GPU form: hit counted on the splat that ends",
        "blend_gpu.cl",
        "if (ANY(hit)) atomic_add(counts + turn, hit_count(hit))",
        "if (ANY(hit | MASK(t < (FW)0.0f))) atomic_add(counts + turn, hit_count(hit | MASK(t < (FW)0.0f)))",
        "gpu",
    ),
    Mutation("GPU form: pixels outside are open", "blend_gpu.cl", "(FW)1.0f, (FW)-1.0f", "(FW)1.0f, (FW)1.0f", "gpu"),
    Mutation("GPU form: no background", "blend_gpu.cl", "fma(fabs(t), (FW)background_r, red)", "red", "gpu"),
    backward("gradient beyond the Jacobian's clamp", "pick(MASK(uc == u), j00 * e02, (FW)0.0f)", "j00 * e02"),
    backward("colours below 0 have a gradient", "pick(MASK(RECORD(6 + c) > (FW)0.0f), SUM(c), (FW)0.0f)", "SUM(c)"),
    backward("gradient: sign of the turn about z", "h11 * v10) - fma(h00", "h11 * v10) + fma(h00"),
    backward("gradient of the opacity, not of its logit", "slope * ((FW)1.0f - opacity)", "slope"),
    backward("gradient along the direction of SH", "tx = fma(-along, dx, tx) * norm", "tx = tx * norm"),
    backward("gradient: opacity's factor held", "if (antialiased) {\n    // log", "if (antialiased > 1) {\n    // log"),
    backward(
        "gradient: what is behind stays as it was", "red[k] = fma(-weight, own_light, red[k]);", "", "blend_cpu.cl"
    ),
    backward(
        "gradient at the cap of alpha", "pick(MASK(alpha < (FW)ALPHA_MAX), light, (FW)0.0f)", "light", "blend_cpu.cl"
    ),
    backward(
        "descent without Adam's correction",
        "whole_first = quotient((FW)1.0f, (FW)1.0f - power_first)",
        "whole_first = (FW)1.0f",
        "descend.cl",
        reference=False,
    ),
    backward(
        "descent: opposite quaternions on the grid",
        "inv = pick(MASK(w < (FW)0.0f), -inv, inv);",
        "",
        "descend.cl",
        reference=False,
    ),
    Mutation("SSIM: variance not about the mean", "similarity.cl", "(m[2] - aa)", "m[2]", tests=SIMILARITY),
    Mutation(
        "SSIM: windows one pixel short", "similarity.cl", "k < SSIM_WINDOW", "k < SSIM_WINDOW - 1", tests=SIMILARITY
    ),
    structure("structure: target without a slope", " + b * by[2]", ""),
    structure(
        "structure: windows beyond the picture", "pick(inside, (FW)2.0f * by_mean, (FW)0.0f)", "(FW)2.0f * by_mean"
    ),
    structure(
        "structure: slopes of pixels beyond the range",
        "pick(MASK(a >= (FW)0.0f) & MASK(a <= (FW)1.0f), (FW)factor * slope, (FW)0.0f)",
        "(FW)factor * slope",
    ),
    costs(
        "costs: what is behind stays as it was",
        "er = fma(cr, trans[k], red[k] - whole_r[k])",
        "er = cr * trans[k]",
        "blend_cpu.cl",
    ),
    costs(
        "costs: weights not squared",
        "squares[v] = fma(weight, weight, squares[v])",
        "squares[v] += weight",
        "blend_cpu.cl",
    ),
    costs(
        "GPU form: costs of what is behind",
        "er = fma((FW)splats[n][6], t, red - whole_r)",
        "er = (FW)splats[n][6] * t",
        "blend_gpu.cl",
        "gpu",
        reference=False,
    ),
    costs("costs: each band for itself", "FW square = (FW)0.0f;", "FW square = d[0] = d[1] = d[2] = (FW)0.0f;"),
    costs("costs: mean colour without weights", "+ level * 4 + c, i), w2 * d[c]", "+ level * 4 + c, i), d[c]"),
    costs("costs: high words not added", "low[SUM_LANES] += sum < value;", ""),
    Mutation(
        "refit: negative bases lessen the weight",
        "score.cl",
        "fma(fabs(basis[k]), seen[3]",
        "fma(basis[k], seen[3]",
        tests=REFIT,
    ),
    Mutation(
        "residual with the wrong sign",
        "score.cl",
        "(0, target + i) - LOADF(image, i), out, i)",
        "(0, target + i) * -1.0f + LOADF(image, i), out, i)",
        tests=REFIT,
    ),
    Mutation("FLIP: no edges across", "flip.cl", "edge_x * edge_x + ", "", tests=FLIP),
    Mutation("FLIP: no points", "flip.cl", "larger(fabs(away[3]), fabs(away[4]))", "fabs(away[3])", tests=FLIP),
    Mutation("FLIP: one of two filters of blue", "flip.cl", "b = b + (FW)taps[3 *", "b = b + (FW)taps[2 *", tests=FLIP),
    Mutation("FLIP: dark colours count in full", "flip.cl", "(FW)0.01f * lightness", "(FW)1.0f", tests=FLIP),
    backward(
        "descent: unseen rows move",
        "STOREF(pick(seen, fma(-(FW)rates[k] * share, step, value), value), values, at)",
        "STOREF(fma(-(FW)rates[k] * share, step, value), values, at)",
        "descend.cl",
        reference=False,
    ),
    backward(
        "descent: bands above a row's degree have a price",
        "moves = seen & MASK(own_degree >= (UW)level);",
        "",
        "descend.cl",
        reference=False,
    ),
    backward(
        "descent: chroma on luma's grid",
        "on_grid(red - blue, chroma_step)",
        "on_grid(red - blue, luma_step)",
        "descend.cl",
        reference=False,
    ),
    Mutation(
        "tile lists: the first row of tiles is left out",
        "tiles.cl",
        "for (int top = span.s0; top <= span.s1",
        "for (int top = span.s0 + 1; top <= span.s1",
    ),
    Mutation(
        "tile lists: masks of blocks to the left",
        "tiles.cl",
        "first - 4 * tile_x, (int4)0)",
        "first - 4 * tile_x, (int4)1)",
    ),
    coder(
        "coder: full states are written too late",
        "x >> (32 - RANS_PRECISION) >= freq",
        "x >> (32 - RANS_PRECISION) > freq",
        "encode_chunks.cl",
    ),
    coder("coder: rounds from the front", "(left - 1) % lanes + 1", "min(left, lanes)", "encode_chunks.cl"),
    rows("rows of a file: bands of other rows", "had[degree - 1]++", "i"),
    rows("rows of a file: green's share of the rest", "(float)cg * chroma * 0.5f", "(float)cg * chroma"),
    rows(
        "rows of a file: w rounded twice",
        "(float)sqrt((double)(square > 0.0f ? square : 0.0f))",
        "sqrt(square > 0.0f ? square : 0.0f) * 1.0000001f",
    ),
    coder("coder: states are not filled up", "return (state / RANS_FLOOR - 1) >> 31", "return 0", "chunk_streams.clh"),
    coder(
        "coder: predictions rounded down",
        "mean * (DW)(1.0 / 65536.0) + (DW)0.5",
        "mean * (DW)(1.0 / 65536.0)",
        "chunk_passes.clh",
    ),
    coder(
        "coder: places of far values",
        "long code = start + (rounded[j] & keep) + more",
        "long code = start + more",
        "chunk_passes.clh",
    ),
    coder(
        "coder: raw bits in one place", "(uchar)(offset >> (8 * piece)", "(uchar)(offset >> piece", "chunk_passes.clh"
    ),
)
