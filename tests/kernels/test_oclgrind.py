"""All kernels on Oclgrind's simulator: out-of-bounds accesses, races, divergent barriers.

The simulator is some thousand times slower than a processor, so two tiles must do.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from benchmarks.harness import read_sums
from flexgs_edge.cameras.camera import Camera
from flexgs_edge.codec.v2.container import decode_chunk, write_grid
from flexgs_edge.codec.v2.device.decode_kernel import ChunkKernel
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS, TwinBackend
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.methods.best.costs import measure_costs
from flexgs_edge.methods.best.refit.colour import refit_colours
from flexgs_edge.methods.best.refit.descent import Descent, bit_prices
from flexgs_edge.methods.best.refit.finetune import FIELD_RATES
from flexgs_edge.quality.similarity import flips, ssims
from flexgs_edge.render.fit import Fit
from flexgs_edge.render.renderer import Renderer
from flexgs_edge.render.statistics import Statistics
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.views.references import Original
from grid_scenes import STEPS, make_grid
from kernel_fixtures import default_device, large_budget, same_bits
from quantized_scenes import quantize_all
from synthetic import make_camera, random_scene

ICD_NAME = "liboclgrind-rt-icd.so"
MARK = "simulated:"


def find_icd() -> Path | None:
    """Oclgrind's driver, where Debian and Ubuntu put it or beside other libraries."""
    folders = ["/usr/lib/oclgrind", "/usr/local/lib", "/usr/local/lib/oclgrind", "/usr/lib"]
    return next((Path(folder, ICD_NAME) for folder in folders if Path(folder, ICD_NAME).is_file()), None)


pytestmark = pytest.mark.skipif(find_icd() is None, reason=f"Oclgrind is not installed (no {ICD_NAME})")


class _Counting:
    """Notes which kernels ran."""

    def __init__(self, backend: OpenCLBackend | TwinBackend) -> None:
        self.backend, self.launched = backend, Counter[str]()

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        self.launched[name] += 1
        self.backend.launch(name, size, *args)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backend, name)


def results(backend: OpenCLBackend | TwinBackend) -> Iterator[np.ndarray]:
    """Everything the kernels compute on scenes of two tiles: views, statistics, batches, quantized scenes, second passes."""
    backend.sort_blocks = backend.tile_blocks = 2
    counting: Any = _Counting(backend)
    camera = make_camera(19, 16, focal=18)
    # More splats than a batch of the GPU form holds in one batch of pairs; a few in many batches.
    for rows, pairs in ((70, 1 << 8), (9, 1)):
        source = random_scene(rows, 3, 1, size=-1.2, opacity=-2)
        drawer = Renderer(counting, large_budget(), background=(0.1, 0.2, 0.3), fit=Fit(pairs=pairs))
        with drawer.load(source) as scene:
            yield drawer.render(scene, camera)
            statistics = Statistics.zeros(source.count)
            drawer.add_statistics(scene, camera, statistics)
            yield statistics.hits
            yield statistics.weights
        drawer.release()
    drawer = Renderer(counting, large_budget(), fit=Fit(pairs=16, chunk_rows=37))
    with drawer.load_quantized(quantize_all(source, groups=3)) as scene:
        image = drawer.render(scene, camera)
        yield image
    yield np.array(ssims(counting, [(image, image[::-1])]), np.float64)
    yield np.array(flips(counting, [(image, image[::-1])]), np.float64)
    yield from second_passes(drawer, camera)
    drawer.release()
    assert set(counting.launched) == set(KERNELS)


def second_passes(drawer: Renderer, camera: Camera) -> Iterator[np.ndarray]:
    """Costs of removal and of dropped SH, a round of the colour refit, a step of a descent; chunks that begin at an odd row.

    As many rows as their planes are padded to: a vector that reads past the last row reads past the buffer.
    """
    source = random_scene(64, 4, 4, size=-2)
    with drawer.load(source) as scene:
        costs = measure_costs(drawer, scene, [camera])
        yield costs.removal
        yield costs.sh
        references: Any = [drawer.render_planes(scene, camera).astype(np.float16) + np.float16(0.1)]
        sums = drawer.residual_and_removal_sums(scene, camera, references[0])
        yield read_sums(drawer, sums, 6, source.count)
    planes = source.read(slice(0, source.count), list(FIELD))
    planes = refit_colours(
        planes, np.full(source.count, 4), Original(drawer, source.origin, [camera], references), rounds=1
    )
    yield planes["sh_dc"]
    yield planes["sh_rest"]
    with Descent(drawer, planes, np.full(source.count, 4), source.origin, camera, 0.01) as descent:
        steps = StepSizes(0.01, 0.1, 0.03, 0.2, 0.05, (0.04,) * 4)
        descent.put_on(steps)
        descent.price(bit_prices(planes, np.full(source.count, 4), steps, 0.01))
        descent.step(camera, references[0], {"means": 1e-2, **FIELD_RATES}, share=0.5)
        descent.settle()
        yield from descent.planes().values()


def lane(width: int, form: str) -> None:
    """Body of the subprocess: compare the simulated kernels with the twins."""
    info = default_device()
    assert "oclgrind" in f"{info.name} {info.platform}".lower(), info
    simulated = OpenCLBackend(info, large_budget(), width=width, form=form)
    compared = 0
    for ours, twins in zip(results(simulated), results(TwinBackend(large_budget())), strict=True):
        assert same_bits(np.asarray(ours), np.asarray(twins))
        assert np.any(ours)
        compared += 1
    print(MARK, compared)


def chunks(width: int) -> None:
    """Body of a subprocess: decode chunks, sound and damaged, as NumPy does."""
    simulated = OpenCLBackend(default_device(), large_budget(), width=width, form="cpu")
    counting: Any = _Counting(simulated)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.fgs"
        # Two passes, raw bits, and the end of the planes: as many rows as vectors are whole.
        steps = replace(STEPS, scale=2.0**-11, sh=(2.0**-9, 0.2))
        write_grid(path, make_grid(272, 2, steps=steps), {})
        write_grid(path.with_name("b.fgs"), make_grid(272, 2, steps=steps), {}, device=counting)
        assert path.read_bytes() == path.with_name("b.fgs").read_bytes()
        plain, source = GridSource(path), GridSource(path)
        container = plain.container
        table = np.zeros((272, 17 + 24), np.float32)
        with source.on_device(counting, 1):
            assert source.read_table(slice(0, 272), table).tobytes() == plain.read_table(slice(0, 272), table).tobytes()
        model, data = container.read_model(), container.read_chunk(container.read_table()[0])
    assert any(group.shift for group in model.groups)
    kernel = ChunkKernel(counting, model, 272, len(data), 1)
    wrong = 0
    for trial in range(6):
        damaged = bytearray(data)
        damaged[4 * trial : 4 * trial + 2] = b"\xff\x80"
        if trial % 2:
            del damaged[100 * trial :]
        got = kernel.codes([(272, bytes(damaged))], False)[0]
        try:
            decode_chunk(model, 272, bytes(damaged))
        except ValueError as error:
            assert str(got) == str(error)
            wrong += 1
    assert wrong > 3 and set(counting.launched) == set(CODEC_KERNELS)
    print(MARK, wrong)


def faulty(fault: str) -> None:
    """A kernel that breaks one rule, to see that the simulator says so."""
    backend = OpenCLBackend(default_device(), large_budget(), width=1, form="cpu")
    body = {
        "bounds": "out[get_global_id(0) + 1] = 1.0f;",
        "race": "out[0] = (float)get_global_id(0);",
        "barrier": "if (get_local_id(0) < 2) barrier(CLK_LOCAL_MEM_FENCE); out[get_global_id(0)] = 1.0f;",
    }[fault]
    kernel = backend.kernel(f"__kernel void faulty(__global float *out) {{ {body} }}", "faulty", (), "b")
    array = backend.array((4,), np.float32)
    backend.enqueue("faulty", kernel, (4,), (4 if fault == "barrier" else 1,), (array,))
    backend.close()
    print(MARK, 1)


def simulate(call: str, folder: Path) -> str:
    """Run `call` of this module under Oclgrind; what Oclgrind reported."""
    icd = find_icd()
    assert icd is not None
    vendors = folder / "vendors"
    vendors.mkdir()
    (vendors / "oclgrind.icd").write_text(f"{icd}\n")
    log = folder / "log"
    environment = {
        **os.environ,
        "OCL_ICD_VENDORS": str(vendors),
        # Not OCLGRIND_UNINITIALIZED: with it version 21.10 reports the padding that vectors load, and computes other results.
        "OCLGRIND_DATA_RACES": "1",
        # Oclgrind counts the local memory of all kernels of a program together. Each of ours takes less than 16 KiB.
        "OCLGRIND_LOCAL_MEM_SIZE": str(1 << 16),
        "OCLGRIND_LOG": str(log),
        "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[1] / "helpers"), *filter(None, sys.path)]),
    }
    code = f"import test_oclgrind; test_oclgrind.{call}"
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, timeout=240)
    reported = (log.read_text() if log.is_file() else "") + done.stderr
    # A bad access is not carried out, so that results may differ as well: its report comes first.
    assert done.returncode == 0 and MARK in done.stdout, reported
    return reported


@pytest.mark.parametrize(("width", "form"), [(4, "cpu"), (1, "gpu")])
def test_kernels_break_no_rule(width: int, form: str, tmp_path: Path) -> None:
    assert simulate(f"lane({width}, '{form}')", tmp_path) == ""


@pytest.mark.parametrize("width", [4, 1])
def test_decoding_kernels_break_no_rule(width: int, tmp_path: Path) -> None:
    assert simulate(f"chunks({width})", tmp_path) == ""


@pytest.mark.parametrize(
    ("fault", "words"), [("bounds", "Invalid write"), ("race", "data race"), ("barrier", "divergence")]
)
def test_the_simulator_sees_faults(fault: str, words: str, tmp_path: Path) -> None:
    assert words in simulate(f"faulty('{fault}')", tmp_path)
