"""Mutation testing: plants one fault at a time in a copy of the kernels and shows which test fails.

    python -m benchmarks.mutations                    # all, and writes docs/results/mutations.md
    python -m benchmarks.mutations --only conic -v    # only faults whose name contains a word; writes nothing

The twins stay as they are, so the comparison with them sees every fault by construction. The tests against the float64
reference count, because it knows neither kernels nor twins. (The coder's kernels have no such reference; they are compared
with the coder in NumPy.)
"""

from __future__ import annotations

import argparse
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from benchmarks.harness import ROOT, SCENES

TABLE = ROOT / "docs" / "results" / "mutations.md"
SURVIVED = "survived"


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


def coder(name: str, old: str, new: str) -> Mutation:
    """A fault in the entropy coder."""
    return Mutation(name, "code_chunks.cl", old, new, reference=False, tests=CODER)


def constant(name: str, literal: str, words: str) -> Mutation:
    """A wrong constant, defined again in front of everything else."""
    first_line = "#pragma OPENCL FP_CONTRACT OFF\n"
    return Mutation(words, "common.clh", first_line, f"{first_line}#undef {name}\n#define {name} {literal}\n")


MUTATIONS = (
    Mutation("sign of the conic's B", "project.cl", "out[3] = -(b + b) * k", "out[3] = (b + b) * k"),
    Mutation("sign of the span's slope", "project.cl", "out[11] = b * ic", "out[11] = -b * ic"),
    Mutation("sign of where the ellipse turns", "project.cl", "out[9] = quotient(b, a)", "out[9] = -quotient(b, a)"),
    Mutation("half width from the wrong axis", "project.cl", "half_width = sqrt(t2 * a)", "half_width = sqrt(t2 * c)"),
    constant("DILATION", "0.0f", "no +0.3"),
    constant("DILATION", "0.25f", "+0.25 for +0.3"),
    constant("LOG2_ALPHA_MAX", "0.0f", "no cap of alpha at 0.99"),
    constant("LOG2_ALPHA_MAX", "-0.0291463f", "cap of alpha at 0.98"),
    constant("LOG2_ALPHA_MIN", "-8.0f", "1/256 for 1/255"),
    constant("LOG2_ALPHA_MIN", "-7.9657843f", "1/250 for 1/255"),
    constant("TRANSMITTANCE_MIN", "1e-3f", "pixels end at 1e-3"),
    constant("TRANSMITTANCE_MIN", "1e-5f", "pixels end at 1e-5"),
    constant("EXTENT_SLACK", "-0.01f", "ellipse too small"),
    constant("EXP2_POLY_5", "0.0f", "exp2 of degree 4"),
    constant("SIGMA_RADIUS_INRIA", "2.5f", "2.5 sigma for --extent inria"),
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
    Mutation(
        "hit counted on the splat that ends",
        "common.clh",
        "return hit;",
        "return seen & MASK(t > (FW)0.0f);",
    ),
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
    Mutation("FLIP: no edges across", "flip.cl", "edge_x * edge_x + ", "", tests=FLIP),
    Mutation("FLIP: no points", "flip.cl", "larger(fabs(away[3]), fabs(away[4]))", "fabs(away[3])", tests=FLIP),
    Mutation("FLIP: one of two filters of blue", "flip.cl", "b = b + (FW)taps[3 *", "b = b + (FW)taps[2 *", tests=FLIP),
    Mutation("FLIP: dark colours count in full", "flip.cl", "(FW)0.01f * lightness", "(FW)1.0f", tests=FLIP),
    coder("coder: states are not filled up", "return (state / RANS_FLOOR - 1) >> 31", "return 0"),
    coder("coder: predictions rounded down", "mean * (DW)(1.0 / 65536.0) + (DW)0.5", "mean * (DW)(1.0 / 65536.0)"),
    coder("coder: places of far values", "long code = start + (rounded[j] & keep) + more", "long code = start + more"),
    coder("coder: raw bits in one place", "(uchar)(offset >> (8 * piece)", "(uchar)(offset >> piece"),
)


def kernel_folder(parent: Path, mutation: Mutation | None) -> Path:
    """A copy of the kernels with the fault, or without one. Raises if the text to replace does not occur."""
    folder = parent / "cl_kernels"
    shutil.rmtree(folder, ignore_errors=True)
    shutil.copytree(ROOT / "cl_kernels", folder, ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    if mutation is not None:
        path = folder / mutation.file
        text = path.read_text()
        if mutation.old not in text:
            raise LookupError(
                f"{mutation.name}: {mutation.file} has no text {mutation.old!r}: bring the mutation up to date"
            )
        path.write_text(text.replace(mutation.old, mutation.new))
    return folder


@contextmanager
def workplace() -> Iterator[Path]:
    """A temporary folder for kernels and for the compiler's cache."""
    with tempfile.TemporaryDirectory(prefix="mutations-") as name:
        yield Path(name)


def run_tests(place: Path, files: tuple[str, ...], keywords: str) -> str | None:
    """The first test that fails on the kernels in `place`, or None."""
    environment = {**os.environ, "FLEXGS_KERNEL_DIR": str(place / "cl_kernels"), "POCL_CACHE_DIR": str(place / "pocl")}
    missing = [file for file in files if not (ROOT / file).is_file()]
    if missing:
        raise LookupError(f"no {', '.join(missing)}: bring the tests of the mutations up to date")
    command = [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", "--no-cov", "-k", keywords, *files]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True)
    failed = re.search(r"^(?:FAILED|ERROR) tests/(.+?)(?: - .*)?$", done.stdout, re.MULTILINE)
    if done.returncode not in (0, 1) or (done.returncode == 1 and not failed):
        raise RuntimeError(f"pytest ended with {done.returncode}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return failed.group(1) if failed else None


def judge(place: Path, mutation: Mutation | None, tests: Tests, verbose: bool = False) -> tuple[str | None, ...]:
    """The first test that fails against the reference, against the twins, and against the golden renders."""
    kernel_folder(place, mutation)
    form = mutation.form if mutation else "(w16 or gpu)"
    found = tuple(
        run_tests(place, files, words.format(form=form)) if files else None
        for files, words in (
            (tests.reference, tests.reference_words),
            (tests.twins, tests.twin_words),
            (GOLDEN if tests.golden else (), "images or statistics"),
        )
    )
    if verbose:
        print(f"{mutation.name if mutation else 'no fault'}: {found}", flush=True)
    return found


def table(rows: list[tuple[Mutation, tuple[str | None, ...]]]) -> str:
    """The page with all faults and the tests that see them."""
    seen: dict[str, list[str]] = {}
    drawn = [row for row in rows if row[0].tests.golden and row[0].form != "gpu" and row[0].file != "dequantize.cl"]
    golden = [bool(found[2]) for _, found in drawn]
    for mutation, (reference, twins, _) in rows:
        first = reference if mutation.reference else twins
        seen.setdefault(_test(first) if first and twins else SURVIVED, []).append(mutation.name)
    lines = [
        "# Planted faults",
        "",
        f"{len(rows)} faults were planted in a copy of the OpenCL kernels, one at a time. Against the NumPy twins, which stay",
        f"as they are, {sum(bool(found[1]) for _, found in rows)} of them turned a test red. A row gives the first test against",
        "the float64 reference that turned red too, or the twins' test for faults that change no value, and the faults. Of",
        f"{len(golden)} faults in drawing, {sum(golden)} also turn the golden renders of the fox scene red.",
        "",
        "`python -m benchmarks.mutations` makes this page in about ten minutes. `test_kernels_mutations.py` plants three",
        "faults with every test run, and checks that the text of all is still in the kernels.",
        "",
        "| first test | faults |",
        "|---|---|",
    ]
    lines += [f"| {test} | {'; '.join(names)} |" for test, names in seen.items()]
    return "\n".join(lines) + "\n"


def _test(name: str) -> str:
    """The name of a test without its folder and its parameters."""
    return f"`{name.partition('[')[0].rpartition('/')[2]}`"


def main() -> int:
    """Run the mutations; returns 1 if one survives."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", metavar="WORD", help="mutations whose name holds this word; the page is not written")
    parser.add_argument("-v", "--verbose", action="store_true", help="a line for each mutation as it is done")
    options = parser.parse_args()
    if not options.only and not (SCENES["fox"] / "golden.npz").is_file():
        parser.error(
            f"the page has a column for the fox scene, and there is none at {SCENES['fox']}: set FLEXGS_SCENES"
        )
    chosen = [mutation for mutation in MUTATIONS if not options.only or options.only in mutation.name]
    with workplace() as place:
        for tests in dict.fromkeys(mutation.tests for mutation in chosen):
            healthy = judge(place, None, tests)
            if any(healthy):
                print(f"the tests fail on the kernels as they are: {healthy}", file=sys.stderr)
                return 2
        rows = [(mutation, judge(place, mutation, mutation.tests, options.verbose)) for mutation in chosen]
    page = table(rows)
    if options.only:
        print(page)
    else:
        TABLE.write_text(page)
    survivors = [m.name for m, found in rows if not found[1] or (m.reference and not found[0])]
    print(f"{len(rows)} faults, {len(survivors)} survived" + "".join(f"\n  {name}" for name in survivors))
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
