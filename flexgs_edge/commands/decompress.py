"""`decompress`: write a scene as a PLY that every viewer opens, or in another program's format, and tell what that loses."""

import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np

from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.open_fgs import read_header
from flexgs_edge.codec.v2.container import GridContainer, Preview
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import GridHeader
from flexgs_edge.constants import SH_C0
from flexgs_edge.errors import BudgetError, DeviceError, InputError
from flexgs_edge.files import check_folder, check_writable
from flexgs_edge.io import exchange
from flexgs_edge.io.codes import opacities
from flexgs_edge.io.formats import FORMATS, WRITTEN, Format, written_format
from flexgs_edge.io.ply import inria_dtype, write_ply
from flexgs_edge.io.reading import AS_WRITTEN, PLAIN, Reading, Writing
from flexgs_edge.io.streamed_sog_writer import STREAMED
from flexgs_edge.kernels.tested import BUILD_BYTES, RUNTIME_BYTES
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import LOG, Stopwatch
from flexgs_edge.report.file_results import ConversionLoss, DecompressResult
from flexgs_edge.run.decoding import ahead, decode_bytes, decoded_once, decoder
from flexgs_edge.run.inputs import CheckedScene, ScenePlace, load_scene, scene_info
from flexgs_edge.run.open_renderer import open_renderer, run_info
from flexgs_edge.run.open_scene import is_fgs, scene_file
from flexgs_edge.run.options import AUTO_CAMERAS, NO_CAMERAS, ViewOptions
from flexgs_edge.run.quality_evaluator import QualityEvaluator
from flexgs_edge.run.run import open_run
from flexgs_edge.scene.source import SceneSource

WRITE_COPIES = 3  # Copies of a chunk's rows in memory while decoding and writing: codes, planes, rows of the PLY
LEAST_ROWS = 1024  # Rows of a PLY that are written at a time, at least
SPARE_SHARE = 8
"""Of what decoding takes, one part in so many is left free beside rows of a PLY: docs/results/tuning.md#heap"""
WARN_DROP = 0.5  # We warn of a conversion whose pictures lose more than this, dB
ANTIALIASED_NOTE = "an antialiased model: the file does not say so; viewers must be told, and here --antialiased"
_ROWS = 1 << 16  # Rows whose values are compared


def decompress(
    input: ScenePlace,
    output: str | os.PathLike[str],
    force: bool = False,
    memory_limit: int | None = None,
    device: str | None = None,
    reading: Reading = AS_WRITTEN,
    writing: Writing = PLAIN,
    recenter: bool = False,
    cameras: str | None = None,
) -> DecompressResult:
    """Decode a scene to a PLY in INRIA's layout, or convert it to another format.

    The PLY is little endian with zero normals, and is written chunk by chunk. Its positions have the type that came in.

    `input`: a `.fgs`, a `.ply`, a file of another program's format, a model folder, or a scene that is open. `output`: the
    `.ply`, `.spz`, `.sog` or `.compressed.ply` to write, or `FOLDER/lod-meta.json` for streamed SOG. `memory_limit`: bytes
    for the whole process. Default: three quarters of the free memory. `device`: decodes and draws: a processor as `devices`
    lists it, or `numpy`. Default: see `decoder`. `recenter`: move a scene that lies far from zero to zero, and write the
    offset beside `output` (other programs' formats). `cameras`: of the pictures that tell what another program's format
    loses; `none`: no pictures. Default: those beside the scene, else generated ones. Returns paths, sizes, times and memory.
    Raises `InputError` if a path or a format is not usable. Raises `FormatError` if the input does not follow its format.
    """
    streamed = Path(output).name == STREAMED
    format = FORMATS[".sog"] if streamed else written_format(output, writing)
    if format is None and Path(output).suffix.lower() != ".ply":
        raise InputError(f"-o {output}: expected a name that ends in .ply, {', '.join(WRITTEN)}, or {STREAMED}")
    if streamed:
        check_folder(Path(output).parent, force)
    else:
        check_writable(output, force)
    if format is None and (recenter or writing.force_lossy):
        raise InputError(
            f"--{'recenter' if recenter else 'force-lossy'}: a .ply holds the scene as it is; leave it out, or write one of "
            f"{', '.join(WRITTEN)}"
        )
    if format is not None and writing.double:
        raise InputError(f"--double: only a .ply has positions of another type, not {format.suffix}; leave it out")
    if cameras not in (None, AUTO_CAMERAS, NO_CAMERAS):
        read_cameras(cameras)
    clock = Stopwatch()
    budget = MemoryBudget.from_limit(memory_limit)
    with clock.stage("open"):
        scene = load_scene(input, reading=replace(reading, budget=budget))
        enough = budget.used + scene.held_bytes + _writing_bytes(scene.source, format)
        budget.foreseen = lambda: enough
        budget.take("reading the scene", scene.held_bytes)
        recenter = recenter and bool(np.any(scene.source.origin))
        if recenter:
            check_writable(exchange.offset_place(output), force)
    antialiased = scene.settings.get("antialiased") is True
    backend = decoder(device, scene.source, budget, clock)
    warnings: tuple[str, ...] = ()
    with clock.stage("write"):
        if format is not None:
            needed = format.memory * scene.source.count
            budget.require(f"writing a {format.suffix}", needed)
            source = decoded_once(scene.source, budget, needed, backend)
            scene = replace(scene, source=source)
            source = exchange.MovedSource(source, np.zeros(3)) if recenter else source
            warnings = exchange.check_positions(source, format, writing.force_lossy)
            writing = replace(writing, antialiased=antialiased, force_lossy=True)  # positions are checked
            if streamed:
                layers, preview = _layers(input, source.count, reading)
                notes = exchange.write_streamed(
                    Path(output).parent, source, layers, preview=preview, force=force, writing=writing
                )
            else:
                notes = exchange.write_foreign(output, source, force=force, writing=writing)
        else:
            row = WRITE_COPIES * inria_dtype(scene.source.sh_degree).itemsize
            least, decoding = min(scene.source.count, LEAST_ROWS), decode_bytes(scene.source, backend)
            rows = budget.rows("decoding", row, fixed=decoding + decoding // SPARE_SHARE, minimum=least, most=65536)
            budget.take("writing rows", row * rows)  # what is left decodes further chunks ahead
            with ahead(scene.source, budget, backend):
                double, warnings = (True, ()) if writing.double else exchange.wants_double(scene.source, rows)
                notes = write_ply(output, scene.source, force=force, chunk_rows=rows, double=double)
        if recenter:
            assert format is not None
            notes = (*notes, exchange.write_offset(output, scene.source.origin, format, force))
        if antialiased and not (format is not None and format.marks_antialiased):
            notes = (*notes, ANTIALIASED_NOTE)
    size = _written_bytes(Path(output)) if streamed else os.stat(output).st_size
    loss = None
    if format is not None:
        options = ViewOptions(cameras=cameras, device=device, memory_limit=memory_limit)
        with clock.stage("compare"):
            loss = conversion_loss(scene, output, options, None if streamed else format, recentred=recenter)
        if loss.drop is not None and loss.drop > WARN_DROP:
            warnings += (
                f"the pictures lose {loss.drop:.2f} dB, since {format.suffix} does not hold all of this scene; "
                f"flexgs-edge decompress {scene.path or 'SCENE'} -o OUT.ply loses nothing",
            )
    for warning in warnings:
        LOG.warning("warning: %s", warning)
    info = run_info(budget, clock, backend)
    return DecompressResult(scene_info(scene), os.fspath(output), size, info, notes, loss, warnings)


def _writing_bytes(source: SceneSource, format: Format | None) -> int:
    """Bytes that decoding and writing take at least."""
    decoding = decode_bytes(source, None)
    if format is not None:
        return format.memory * source.count + decoding
    row = WRITE_COPIES * inria_dtype(source.sh_degree).itemsize
    return row * min(source.count, LEAST_ROWS) + decoding + decoding // SPARE_SHARE


def _layers(input: ScenePlace, count: int, reading: Reading) -> tuple[tuple[int, ...], SceneSource | None]:
    """Gaussians of each layer of a layered `.fgs`, and its preview, if there is one; other scenes have one layer.

    Where the scene is turned, its preview is left out.
    """
    if not isinstance(input, CheckedScene):
        place = scene_file(input)
        header = read_header(place) if is_fgs(place) else None
        if isinstance(header, GridHeader) and sum(header.layers) == count:
            wanted = header.preview.length and reading.frame is None
            preview = GridSource(place, Preview(GridContainer(place))) if wanted else None
            return tuple(header.layers), preview
    return (count,), None


def _written_bytes(output: Path) -> int:
    """Bytes of a streamed scene: its `lod-meta.json` and all files that it names."""
    names: list[str] = json.loads(output.read_bytes())["filenames"]
    folders = [output.parent / name for name in names]
    return output.stat().st_size + sum(file.stat().st_size for place in folders for file in place.parent.iterdir())


def conversion_loss(
    scene: CheckedScene,
    output: str | os.PathLike[str],
    options: ViewOptions,
    format: Format | None,
    recentred: bool = False,
) -> ConversionLoss:
    """Compare a written file with its scene, by the views and the photos that `evaluate` takes.

    `scene`: what was written to `output`. `options`: cameras, device and memory limit of the pictures. `format`: what the
    file's rows are ordered for, so that values can be compared; `None`: they have another order. `recentred`: the file's
    scene was moved to zero. Returns the loss without pictures where the options name no cameras, or device or memory do
    not allow any: `why` says so.
    """
    written = load_scene(output)
    if recentred:
        written = replace(written, source=exchange.MovedSource(written.source, scene.source.origin))
    values = {} if format is None else _value_errors(scene.source, written.source, format.chunked)
    if options.cameras == NO_CAMERAS:
        return ConversionLoss(values, why=f"--cameras {NO_CAMERAS}")
    if options.device == "numpy" and options.cameras is None:
        return ConversionLoss(values, why="NumPy draws slowly: --cameras PATH compares them all the same")
    try:
        run = open_run(scene, options)
        if options.device != "numpy":
            run.budget.require("the OpenCL runtime", RUNTIME_BYTES + BUILD_BYTES)
        chosen = run.seen.held_out or run.seen.train
        with open_renderer(run) as renderer:
            judge = QualityEvaluator(renderer, run.source, run.seen, chosen)
            with renderer.load(run.source) as original:
                judge.prepare(original)
            with renderer.load(written.source) as drawn:
                quality = judge.compare(drawn)
            judge.close()
    except (BudgetError, DeviceError, InputError) as error:
        return ConversionLoss(values, why=str(error))
    covered = quality.covered_decides
    found = [view.covered_fidelity if covered else view.fidelity for view in quality.views]
    return ConversionLoss(
        values,
        views=len(chosen),
        cameras=run.seen.cameras_from,
        fidelity=quality.deciding_fidelity,
        worst=min((value for value in found if value is not None), default=None),
        drop=quality.usual_drop,
        base_psnr=None if run.seen.photos is not None else quality.base_psnr,
    )


def _value_errors(source: SceneSource, written: SceneSource, chunked: bool) -> dict[str, tuple[float, float]]:
    """Median and largest errors of some rows by value; the size of a splat is its largest deviation."""
    order = exchange.near_order(source, chunked)
    rows = np.arange(0, source.count, -(-source.count // _ROWS))
    fields = ["means", "log_scales", "opacity_logits", "sh_dc"]
    before, after = source.select(order[rows]).read(slice(0, rows.size), fields), written.read(rows, fields)
    shift = (written.origin - source.origin)[:, None]
    with np.errstate(over="ignore"):
        sizes = np.exp(before["log_scales"].astype(np.float64).max(axis=0))
    opaque = [opacities(planes["opacity_logits"]) for planes in (before, after)]
    errors = {
        "position": np.abs(after["means"] + shift - before["means"]).max(axis=0),
        "position_by_size": np.abs(after["means"] + shift - before["means"]).max(axis=0) / sizes,
        "log_scale": np.abs(after["log_scales"] - before["log_scales"]).max(axis=0),
        "opacity": np.abs(opaque[1] - opaque[0])[0],
        "colour": np.abs(after["sh_dc"] - before["sh_dc"]).max(axis=0) * SH_C0,
    }
    return {name: (float(np.median(error)), float(error.max())) for name, error in errors.items()}
