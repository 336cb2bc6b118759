"""What the self-test of a device draws and codes: small scenes with all that kernels tell apart."""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any, cast

import numpy as np

from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import write_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.constants import (
    LOG2_ALPHA_MAX,
    LOG2_ALPHA_MIN,
    ROW_BLOCK,
    ROW_SPAN,
    SSIM_WINDOW,
    SUM_LANES,
    TILE,
    TRANSMITTANCE_MIN,
)
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.grid.to_grid import to_grid
from flexgs_edge.kernels.twins.arithmetic import fexp2
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.descent import Descent, bit_prices
from flexgs_edge.methods.best.refit.finetune import FIELD_RATES
from flexgs_edge.methods.paper.prune import nonzero_sh
from flexgs_edge.packed.bitpack import PAPER, BitSpec
from flexgs_edge.packed.quantize import quantize_scene
from flexgs_edge.quality.similarity import flips, ssims
from flexgs_edge.render.fit import Fit
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.fields import FIELD, FIELDS, sh_rest_count
from flexgs_edge.scene.source import MemorySource
from flexgs_edge.views.references import Original

BLOCKS = 5
"""Work-items of the serial passes: enough that some have no splats, and no divisor of the rows."""
PAIRS = 1 << 12
"""Room for pairs, where a scene is drawn in one batch: the self-test clears and compares all of it."""
WORTH = 0.01
"""Squared error that a bit is worth, for descents."""
STEPS = StepSizes(0.01, 0.1, 0.03, 0.2, 0.05, (0.04, 0.05, 0.06, 0.07))


def camera(width: int, height: int, turn: float = 0.0, off: float = 0.0) -> Camera:
    """Looks along z, turned about y; the principal point is off the centre by `off` pixels."""
    rotation = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    return Camera(
        width=width, height=height, fx=0.9 * width, fy=0.95 * width, cx=(width - 1) / 2 + off, cy=(height - 1) / 2 - off,
        rotation=rotation, translation=np.array([0.02, -0.03, 0.1]), name="self-test",
    )  # fmt: skip


def short(values: np.ndarray) -> np.ndarray:
    """Values with few bits, so that the record is small."""
    return np.clip(values, -6e4, 6e4).astype(np.float16).astype(np.float32)


def scene(count: int, degree: int, seed: int, size: float = -2.2, opacity: float = 0.0) -> MemorySource:
    """A cloud before the camera. Its first rows are the ones that are easy to get wrong."""
    rng = np.random.default_rng([seed, count])
    means = np.stack([rng.uniform(-2.6, 2.6, count), rng.uniform(-2, 2, count), rng.uniform(1.5, 6, count)])
    logits, scales = rng.normal(opacity, 2.5, (1, count)), rng.normal(size, 0.8, (3, count))
    quats = rng.normal(size=(4, count)) * rng.uniform(0.4, 1.8, count)
    odd = np.arange(count) % 7 == 3
    means[2, odd] = means[2, np.roll(odd, 1)]  # equal depths
    means[2, :6] = -1, 0.15, 0.1, 0.5, 0.25, 40  # behind, before and about the near plane, far
    scales[:, 6:9] = np.array([[-9.0, 2.0, -9.0]]).T  # needles
    scales[:, 9:12], scales[:, 12:14] = -12, 1.5  # below a pixel; fills the screen
    scales[:, 14:16] = np.array([[-1.0, -20.0, -1.0]]).T  # flat
    logits[0, 12:14] = -2, -4
    logits[0, 16:22] = -5.5412636, -5.55, 40, -40, 9, 12  # about 1/255, and at both ends
    quats[:, 22:26] *= 1e-18, 1e18, 1e-3, 1
    quats[:3, 25] = 0
    means[:2, 26:30] = [[-2.5, 2.5, 0, 0], [0, 0, -2.0, 2.0]]  # beyond the edges
    scales[:, 26:30] = -0.5
    rest = rng.normal(0, 0.35, (3 * sh_rest_count(degree), count))
    rest[:, 30:34] = 0
    arrays = {
        "means": means, "sh_dc": rng.normal(0, 1.2, (3, count)), "sh_rest": rest, "opacity_logits": logits,
        "log_scales": scales, "quats": quats,
    }  # fmt: skip
    short_arrays = {name: short(values) for name, values in arrays.items() if name != "quats"}
    return MemorySource(short_arrays | {"quats": quats.astype(np.float32)}, degree)


def draw_all(backend: Any) -> None:
    """Every kernel that draws, sums, compares or descends."""
    budget = MemoryBudget(1 << 40)
    rng = np.random.default_rng(5)
    # More rows than a work-group, edges in mid-tile, tiles without splats.
    big, wide = scene(330, 3, 1), camera(75, 53, 0.1)
    # Black in one channel, so that some values are 0 exactly.
    drawer = Renderer(backend, budget, background=(0.1, 0.0, 0.3), fit=Fit(pairs=PAIRS))
    with drawer.load(big) as loaded:
        image = drawer.render_planes(loaded, wide)
        drawer.add_statistics(loaded, wide, Statistics.zeros(big.count))
        drawer.removal_sums(loaded, wide)
        target = (image + rng.uniform(-0.2, 0.2, image.shape).astype(np.float32)).astype(np.float16)
        target = np.round(target * 32) / np.float16(32)
        drawer.residual_sums(loaded, wide, target)
        drawer.residual_and_removal_sums(loaded, wide, target)
        drawer.gradient_sums(loaded, wide, target, 0.3)
    drawer.release()
    similar = np.round(image[:, :34, :45].transpose(1, 2, 0) * 32) / np.float32(32)
    ssims(backend, [(similar, similar[::-1])])
    similar[:4, :4] = 0.04045  # where the curve of sRGB has its knee
    flips(backend, [(similar, np.clip(similar * 1.25 - 0.125, 0, 1)), (similar, 1 - np.clip(similar, 0, 1))])
    edges(backend)
    for degree in (0, 1, 2, 4):
        for_degree(backend, budget, degree)
    for antialiased, pairs in ((False, 1 << 8), (True, 1), (True, PAIRS)):
        small = scene(60, 1, 9, opacity=-1)
        drawer = Renderer(backend, budget, 0.3, (0.3, 0.0, 0.9), antialiased, Fit(pairs=pairs, chunk_rows=37))
        view = camera(40, 35, -0.2, 3.0)
        with drawer.load(small) as loaded:
            drawer.render_planes(loaded, view)
            drawer.add_statistics(loaded, view, Statistics.zeros(small.count))
        drawer.release()
    for bits in (PAPER, BitSpec(13, 7, 8, 11, 16, 3)):
        has_sh = nonzero_sh(small)
        quantized = quantize_scene(small, np.flatnonzero(has_sh), np.flatnonzero(~has_sh), bits, 3)
        drawer = Renderer(backend, budget, fit=Fit(pairs=PAIRS, chunk_rows=37))
        with drawer.load_quantized(quantized) as loaded:
            drawer.render_planes(loaded, camera(20, 18))
        drawer.release()


def call(backend: Any, name: str, size: int, *args: Any) -> None:
    """Launch a kernel on arrays of the host."""
    plain = [backend.array(arg.shape, arg.dtype) if isinstance(arg, np.ndarray) else arg for arg in args]
    for array, values in zip(plain, args, strict=True):
        if isinstance(values, np.ndarray):
            backend.write(array, values)
    backend.launch(name, (size,), *plain)
    for array, values in zip(plain, args, strict=True):
        if isinstance(values, np.ndarray):
            array.release()


def edges(backend: Any) -> None:
    """Numbers that scenes hardly reach: sums about to overflow, values at a limit, gradients near zero."""
    f32, rows = np.float32, 64
    some = np.arange(rows)
    # Adam: gradients and means about the least, rows that no view touched.
    gradient = np.where(some % 3, 10.0 ** (some % 7 - 18.0), -0.5).astype(f32)
    ones = np.ones((1, rows), f32)
    powers = np.stack([some % 2 + 0.5, some % 2 + 0.25]).astype(f32) * f32(0.4)
    pace = ((some % 5 > 0) / (some % 4 + 1)).astype(f32)
    values, drawn = np.tile(ones, (14, 1)), [np.zeros((width, rows), f32) for width in (3, 3, 4, 1, 3, 1, 6, 1)]
    call(
        backend, "descend", rows, rows, 0, 14, 0, 0, 1, 0.9, 0.999, 0.25, np.full(14, 0.01, f32), np.zeros(33, f32),
        np.full(14, 0.125, f32), np.zeros(rows, np.uint32), pace, np.tile(gradient, (14, 1)), powers,
        np.tile(gradient[::-1] * f32(1e-3), (14, 1)), values * f32(1e-29), values, values * f32(0.5), *drawn,
    )  # fmt: skip
    # Costs: both words, sums at the ends of their range.
    sums = np.empty((rows, 2), np.int64)
    sums[:, 0], sums[:, 1] = (
        (some.astype(np.int64) << 57) + 12345,
        np.where(some % 4, (some.astype(np.int64) + 1) << 40, 0),
    )
    costs = np.zeros((rows // SUM_LANES, 8, SUM_LANES), np.int64)
    costs[:, :4] = -1
    costs[:, 4:] = np.where(some.reshape(-1, 1, SUM_LANES) % 2, 2**63 - 1000, -(2**63) + 1000)
    places = np.stack([some % 8 - 3.5, some % 5 - 2.0, some % 3 + 1.0]).astype(f32)
    bands = (np.stack([(some * k) % 11 - 5 for k in range(1, 10)]) * 0.25).astype(f32)
    record = np.zeros(32, f32)
    blocks = np.arange(-(-rows // ROW_BLOCK), dtype=np.uint32)
    words = sums.view(np.uint32).reshape(rows, 2, 2)
    call(backend, "add_costs", rows, rows, rows, 0, 0, 1, 2, 0, blocks, record, places, bands, words, costs)
    # A pixel that a splat reaches with the least alpha that shows, and sums whose low words are full.
    splats = np.zeros((3, 16), f32)
    splats[:, 2:5] = 0.02, 0.0, 0.02
    splats[:, :2] = [[3, 3], [8, 8], [12, 4]]
    splats[:, 5] = LOG2_ALPHA_MIN, LOG2_ALPHA_MAX, -3.0
    splats[:, 6:9] = 0.25, 0.5, 1.0
    pairs = np.array([[0, 0xFFFF], [1, 0xFFFF], [2, 0xFFFF]], np.uint32)
    image, ends = np.zeros((3, TILE, TILE), f32), np.full(BLOCKS, 3, np.uint32)
    full = np.full((3, 9, 2), 0xFFFFFFFF, np.uint32)
    # Pixels that a flat splat of alpha 1/2 brings to the least transmittance, exactly, and close to it on both sides.
    state, flat = np.zeros((1, 4, 256), f32), np.zeros((1, 16), f32)
    about = np.array(TRANSMITTANCE_MIN / (1 - fexp2(np.full(1, -1, f32))), f32).view(np.uint32)
    state[0, 3] = (about + np.arange(256, dtype=np.uint32) - 128).view(f32)
    flat[:, 5:9] = -1.0, 0.25, 0.5, 1.0
    call(
        backend,
        "blend",
        1,
        1,
        BLOCKS,
        TILE,
        TILE,
        1,
        1,
        0.5,
        0.25,
        0.0,
        np.full(BLOCKS, 1, np.uint32),
        pairs[:1],
        flat,
        state,
        image,
    )
    for name, planes in (("blend", 0), ("blend_stats", 1), ("blend_removal", 2), ("blend_backward", 9)):
        extra: list[np.ndarray] = [np.full(3, 7, np.uint32), np.ascontiguousarray(full[:, :planes])] if planes else []
        extra += [np.full((3, TILE, TILE), 0.5, f32)] if planes == 9 else []
        call(
            backend, name, 1, 1, BLOCKS, TILE, TILE, 0, 1, 0.5, 0.25, 0.0, ends, pairs, splats, np.zeros((1, 4, 256), f32), image,
            *extra,
        )  # fmt: skip

    call(backend, "residual", rows, rows, (some / 16).astype(np.float16), some[::-1].astype(f32), ones[0])
    # Who reads behind the window's taps finds no zeros.
    moments = np.stack([some % 5, some % 3, some % 7, some % 4, some % 6]).astype(f32) / 8
    call(
        backend,
        "ssim_rows",
        rows,
        rows,
        2 * rows,
        np.full(2 * SSIM_WINDOW, 0.125, f32),
        np.tile(moments, 2),
        some.astype(f32),
    )
    # Pixels at the ends of what a screen shows, where the structural term has a gradient.
    pixels = np.array([0, 1, -0.5, 0.5, 1.5], f32)[some % 5]
    taps = np.array([0.25, 0.5, 0.25], f32)
    slopes_of = (np.stack([some % 3 + 1, some % 4 - 2, some % 5 + 0.5])).astype(f32)
    slopes = np.tile(np.pad(slopes_of, ((0, 0), (0, 3 * rows))), (3, 1, 1))
    call(
        backend, "dssim_residual", 3 * ROW_SPAN, ROW_SPAN, 1, rows, rows, 4 * rows, 0.5, 3, taps, slopes,
        np.tile(pixels, (3, 1)), np.tile(pixels, (3, 1)).astype(np.float16), np.tile(pixels / 4, (3, 1)),
    )  # fmt: skip


def for_degree(backend: Any, budget: MemoryBudget, degree: int) -> None:
    """Costs, a round of the colour refit, and steps of a descent of a scene of one SH degree."""
    source, view = scene(64, degree, 3 + degree), camera(33, 30, 0.3, 1.5)
    if degree == 1:
        # A sampled view, whose window is shorter than the array of its taps: who reads behind it finds no zeros.
        view = camera(66, 60, 0.3, 1.5).every(2)
    drawer = Renderer(backend, budget, antialiased=degree == 2, fit=Fit(pairs=PAIRS))
    with drawer.load(source) as loaded:
        measure_costs(drawer, loaded, [view])
        image = drawer.render_planes(loaded, view)
        target: Any = (np.round(image * 16) / 16 + 0.125).astype(np.float16)
    planes, targets = source.read(slice(0, source.count), list(FIELD)), cast(Any, [target])
    degrees = np.full(source.count, degree)
    planes = refit_colours(planes, degrees, Original(drawer, source.origin, [view], targets), rounds=1)
    # Short again: what comes next does not depend on all bits of the refit.
    planes = {name: short(values) for name, values in planes.items()}
    with Descent(drawer, planes, degrees, source.origin, view, 0.01) as descent:
        for put in (False, True):
            if put:
                descent.put_on(STEPS)
                descent.price(bit_prices(planes, degrees, STEPS, WORTH))
            for share in (0.0, 0.5):
                descent.step(view, target, {"means": 1e-2, **FIELD_RATES}, share=share)
        descent.settle()
        descent.planes()
    drawer.release()


def code_all(backend: Any) -> None:
    """Write files, and read them back: rows of all SH degrees in several passes, raw bits, repeats."""
    for count, degree in ((272, 3), (600, 0)):
        code(backend, count, degree)


def code(backend: Any, count: int, degree: int) -> None:
    """One file, on the device as by NumPy."""
    rng = np.random.default_rng(8)
    planes = {f.name: rng.normal(size=(f.width(degree), count)).astype(np.float32) for f in FIELDS}
    for name in ("sh_dc", "log_scales", "opacity_logits"):
        planes[name] += 3 * planes["means"][:1]
    planes["means"][:, 5:9] = planes["means"][:, 4:5]  # in one cell
    # Fine steps for the smaller file, whose codes then have raw bits; coarse ones keep the record of the other small.
    scale, colour = (2.0**-11, 2.0**-9) if degree else (0.5, 0.5)
    steps = StepSizes(0.05 if degree else 0.2, scale, 0.05 if degree else 0.2, 0.4, 0.1, (colour, 0.25, 0.3, 0.3))
    degrees, origin = rng.integers(0, degree + 1, count), (1234.5, -0.1, 1e-7)
    grid, _ = to_grid(planes, degrees, steps, origin, np.zeros(count, np.int64))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.fgs"
        write_grid(path, grid, {})
        write_grid(path.with_name("b.fgs"), grid, {}, device=backend)
        assert path.read_bytes() == path.with_name("b.fgs").read_bytes()
        plain, source = GridSource(path), GridSource(path)
        table = np.zeros((count, 17 + 3 * sh_rest_count(degree)), np.float32)
        with source.on_device(backend, 1):
            got = source.read_table(slice(0, count), table).tobytes()
        assert got == plain.read_table(slice(0, count), table).tobytes()
