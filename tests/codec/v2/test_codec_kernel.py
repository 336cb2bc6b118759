"""The kernel that decodes chunks against the NumPy decoder, which is its specification: codes, rows of a PLY, and damage."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flexgs_edge.codec.v2.container import GridContainer, coded_size, decode_chunk, write_grid
from flexgs_edge.codec.v2.device.decode_kernel import ChunkKernel
from flexgs_edge.codec.v2.device.encode_kernels import device_bytes
from flexgs_edge.codec.v2.device.launch import INFO, Device
from flexgs_edge.codec.v2.encode import encode_grid
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.codec.v2.header import CHUNK_ROWS
from flexgs_edge.codec.v2.ports import Model
from flexgs_edge.codec.v2.walk import ChunkCodes
from flexgs_edge.commands.decompress import decompress
from flexgs_edge.constants import CODE_LIMIT
from flexgs_edge.errors import FormatError
from flexgs_edge.grid.grid_scene import GridScene, from_grid
from flexgs_edge.grid.step_sizes import StepSizes
from flexgs_edge.kernels.backend import Backend
from flexgs_edge.kernels.choose_device import DeviceInfo
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.memory.budget import MemoryBudget
from flexgs_edge.progress import Stopwatch
from flexgs_edge.run.decoding import DEVICE_ROWS, ahead, coding_device, decoder
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.scene.source import MemorySource
from grid_scenes import STEPS, assert_same_grid, make_grid
from kernel_fixtures import default_device, large_budget, open_form

FINE = StepSizes(0.05, 2.0**-14, 2.0**-9, 2.0**-12, 2.0**-10, (2.0**-9, 0.25, 2.0**-8, 0.3))
"""Steps at which alphabets have raw low bits."""


@dataclass
class WatchedBudget(MemoryBudget):
    """A budget that knows the most that was taken of it."""

    most: int = 0

    def take(self, stage: str, size: int) -> None:
        super().take(stage, size)
        self.most = max(self.most, self.used)


def same_codes(one: ChunkCodes, two: ChunkCodes) -> bool:
    parts = [(one.cells, two.cells), (one.position, two.position), *zip(one.sh, two.sh, strict=True)]
    parts += [(one.base[name], two.base[name]) for name in two.base]
    return all(np.array_equal(a, b) for a, b in parts)


@contextmanager
def kernel_of(container: GridContainer, model: Model, form: str = "w16", chunks: int = 3) -> Iterator[ChunkKernel]:
    rows = max(chunk.stop - chunk.start for chunk in container.header.chunks())
    longest = max(entry.section.length for entry in container.read_table())
    kernel = ChunkKernel(open_form(form), model, rows, longest + 64, chunks)
    yield kernel
    kernel.close()


def with_outliers(grid: GridScene) -> GridScene:
    """Escapes in every channel, some beyond the values that predictions use, some at the ends of the codes."""

    def strange(codes: np.ndarray, limit: int) -> np.ndarray:
        codes = codes.copy()
        flat = codes.reshape(-1)
        flat[::97] += 20_000
        flat[3::211] -= 300
        flat[5:6], flat[7:8] = limit, -limit
        return codes

    parts = {name: strange(getattr(grid, name), CODE_LIMIT) for name in ("scale", "rotation", "opacity", "dc")}
    return replace(grid, **parts, sh=tuple(strange(band, CODE_LIMIT) for band in grid.sh))


GRIDS = {
    "one row": (make_grid(1, 3), CHUNK_ROWS),
    "two rows": (make_grid(2, 0), CHUNK_ROWS),
    "one pass": (make_grid(256, 1), CHUNK_ROWS),
    "two passes": (make_grid(257, 2), CHUNK_ROWS),
    "odd": (make_grid(2039, 3), CHUNK_ROWS),
    "degree 4": (make_grid(700, 4), CHUNK_ROWS),
    "no sh": (make_grid(777, 0), 300),
    "layers": (make_grid(901, 2, layers=4), 100),
    "chunks of a row": (make_grid(7, 1), 1),
    "raw bits": (make_grid(1500, 4, steps=FINE), 700),
    "escapes": (with_outliers(make_grid(3001, 3)), 1500),
    "both": (with_outliers(make_grid(1201, 3, steps=FINE)), CHUNK_ROWS),
    "same cells": (make_grid(4000, 1, steps=replace(STEPS, position=2.0)), CHUNK_ROWS),
    "one cell": (make_grid(600, 1, steps=replace(STEPS, position=1000.0)), CHUNK_ROWS),
}


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("grids")
    for name, (grid, rows) in GRIDS.items():
        write_grid(folder / f"{name}.fgs", grid, {}, chunk_rows=rows)
    return {name: folder / f"{name}.fgs" for name in GRIDS}


@pytest.mark.parametrize(
    ("name", "form"),
    [*((name, "w16") for name in GRIDS), *((name, form) for form in ("w8", "w4", "w1") for name in ("odd", "both"))],
)
def test_the_same_codes(name: str, form: str, files: dict[str, Path]) -> None:
    container = GridContainer(files[name])
    model = container.read_model()
    jobs = [
        (chunk.stop - chunk.start, container.read_chunk(entry))
        for chunk, entry in zip(container.header.chunks(), container.read_table(), strict=True)
    ]
    with kernel_of(container, model, form) as kernel:
        for first in range(0, len(jobs), 3):
            some = jobs[first : first + 3]
            for base_only in (False, True):
                for (rows, data), codes in zip(some, kernel.codes(some, base_only), strict=True):
                    assert isinstance(codes, ChunkCodes), codes
                    assert same_codes(codes, decode_chunk(model, rows, data, base_only))


@pytest.mark.parametrize(("name", "form"), [*((name, "w16") for name in GRIDS), ("both", "w4"), ("both", "w1")])
def test_the_same_file(name: str, form: str, files: dict[str, Path], tmp_path: Path) -> None:
    grid, rows = GRIDS[name]
    size = write_grid(tmp_path / "a.fgs", grid, {}, chunk_rows=rows, device=open_form(form))
    assert (tmp_path / "a.fgs").read_bytes() == files[name].read_bytes()
    assert coded_size(grid, {}, rows, open_form(form)) == size


def test_no_rows(tmp_path: Path) -> None:
    empty = make_grid(0, 0)
    assert write_grid(tmp_path / "a.fgs", empty, {}) == write_grid(
        tmp_path / "b.fgs", empty, {}, device=open_form("w16")
    )
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()
    source = GridSource(tmp_path / "a.fgs")
    with source.on_device(open_form("w16"), 1):
        assert source.grid().count == 0


class Noting:
    """A device that notes which chunks its kernel has counted."""

    def __init__(self, backend: Backend) -> None:
        self._backend = backend
        self.counted: list[bool] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._backend, name)

    def read(self, array: Any, out: np.ndarray | None = None, offset: int = 0) -> np.ndarray:
        found = self._backend.read(array, out, offset)
        if found.ndim == 2 and found.shape[1] == len(INFO):
            self.counted += (found[:, INFO.index("status")] == 0).tolist()
        return found


def test_a_chunk_of_many_escapes_is_left_to_numpy(tmp_path: Path) -> None:
    """The model is fitted to every second one of eight chunks, whose values say nothing of the second's."""
    grid = make_grid(8000, 2)
    scale = grid.scale.copy()
    scale[:, 1000:2000] += np.arange(1000, dtype=np.int32) * 300
    grid = replace(grid, scale=scale)
    device = Noting(open_form("w16"))
    write_grid(tmp_path / "a.fgs", grid, {}, chunk_rows=1000)
    write_grid(tmp_path / "b.fgs", grid, {}, chunk_rows=1000, device=device)
    assert device.counted == [True, False, *[True] * 6]
    assert (tmp_path / "a.fgs").read_bytes() == (tmp_path / "b.fgs").read_bytes()


def test_when_a_device_codes() -> None:
    backend = open_form("w16")
    assert coding_device(backend, large_budget(), DEVICE_ROWS, 3) is backend
    assert coding_device(backend, MemoryBudget(1 << 20), DEVICE_ROWS, 3) is None
    assert coding_device(backend, large_budget(), DEVICE_ROWS - 1, 3) is None
    for other in (None, open_form("numpy")):
        assert coding_device(other, large_budget(), DEVICE_ROWS, 3) is None


def test_a_processor_codes_for_a_gpu() -> None:
    """If one has a working driver; it is opened once."""
    gpu = OpenCLBackend(replace(default_device(), form="gpu1"), large_budget())
    coder = coding_device(gpu, large_budget(), DEVICE_ROWS, 3)
    assert coder is not None and coder.threads and coder is coding_device(gpu, large_budget(), DEVICE_ROWS, 3)
    alone = OpenCLBackend(replace(default_device(), form="gpu1"), large_budget())
    assert coding_device(alone, large_budget(), DEVICE_ROWS, 3, devices=list) is None
    crowded = OpenCLBackend(replace(default_device(), form="gpu1"), large_budget())
    assert coding_device(crowded, MemoryBudget(1 << 20), DEVICE_ROWS, 3) is None


@pytest.mark.parametrize("name", ["both", "degree 4"])
def test_work_of_coding_stays_below_what_is_declared(name: str) -> None:
    grid, _ = GRIDS[name]
    budget = WatchedBudget(1 << 40)
    watched = OpenCLBackend(default_device(), budget, width=16)
    assert len(list(encode_grid(grid, device=watched).streams())) == 1
    assert budget.used == 0 and 0 < budget.most <= device_bytes(grid.count, grid.sh_degree)


def test_the_grids_have_what_their_names_say(files: dict[str, Path]) -> None:
    for name, (grid, _) in GRIDS.items():
        shifts = [group.shift for group in GridContainer(files[name]).read_model().groups]
        assert max(shifts) > 8 if name in ("raw bits", "both") else max(shifts) < 8
        assert_same_grid(GridSource(files[name]).grid(), grid)
    assert GridContainer(files["one cell"]).header.depth == 0
    repeats = np.unique(GRIDS["same cells"][0].position, axis=1, return_counts=True)[1]
    assert repeats.max() > 16


@pytest.mark.parametrize("name", ["layers", "escapes", "degree 4", "no sh", "one row"])
def test_a_source_on_a_device(name: str, files: dict[str, Path]) -> None:
    """Grid, planes and rows of a PLY, in order and out of it."""
    grid = GRIDS[name][0]
    plain, source = GridSource(files[name]), GridSource(files[name])
    expected = from_grid(grid)
    width = 17 + source.width("sh_rest")
    ranges = [slice(0, grid.count), slice(0, grid.count // 2), slice(grid.count // 3, grid.count), slice(1, 1)]
    tables = [plain.read_table(rows, np.zeros((grid.count, width), np.float32)).copy() for rows in ranges]
    with source.on_device(open_form("w16"), 2):
        assert_same_grid(source.grid(), grid)
        for fields in (list(FIELD), ["means", "quats"]):
            for field, plane in source.read(slice(0, grid.count), fields).items():
                np.testing.assert_array_equal(plane, expected[field])
        for times in range(2):
            for rows, table in zip(ranges, tables, strict=True):
                got = source.read_table(rows, np.zeros((grid.count, width), np.float32))
                assert got.tobytes() == table.tobytes()
            if times == 0:
                with source.whole_in_order(2):
                    for start in range(0, grid.count, 100):
                        rows = slice(start, min(start + 100, grid.count))
                        got = source.read_table(rows, np.zeros((100, width), np.float32))
                        assert got.tobytes() == tables[0][rows].tobytes()
    assert source.read_table(ranges[0], np.zeros((grid.count, width), np.float32)).tobytes() == tables[0].tobytes()


def found(codes: ChunkCodes | ValueError) -> str | ChunkCodes:
    return f"{type(codes).__name__}: {codes}" if isinstance(codes, ValueError) else codes


@pytest.mark.parametrize("name", ["escapes", "raw bits", "odd", "same cells", "one cell"])
def test_damaged_streams_give_the_same_errors(name: str, files: dict[str, Path]) -> None:
    """Bytes changed, streams cut and lengthened: the same error as in NumPy, or the same codes; good neighbours stay good."""
    container = GridContainer(files[name])
    model = container.read_model()
    rows = container.header.chunks()[0].stop
    good = container.read_chunk(container.read_table()[0])
    rng = np.random.default_rng(0)
    errors = set()
    with kernel_of(container, model) as kernel:
        for trial in range(24):
            data = bytearray(good)
            if trial % 4 == 3:
                data = data[: int(rng.integers(0, len(data)))] if trial % 8 == 3 else data + bytes(2)
            elif trial % 4 == 2:
                data[4 * int(rng.integers(1 + len(data) // 8)) :] = rng.bytes(len(data))
                del data[len(good) :]
            else:
                data[int(rng.integers(len(data) // (1 + trial % 2 * 20)))] ^= 1 << int(rng.integers(8))
            got = kernel.codes([(rows, good), (rows, bytes(data)), (rows, good)], False)
            try:
                expected: ChunkCodes | ValueError = decode_chunk(model, rows, bytes(data))
            except ValueError as error:
                expected = error
            if isinstance(expected, ValueError):
                assert found(got[1]) == found(expected)
                errors.add(str(expected).split(",")[0])
            else:
                assert isinstance(got[1], ChunkCodes) and same_codes(got[1], expected)
            for place in (0, 2):
                assert isinstance(got[place], ChunkCodes)
    assert len(errors) >= 3


def test_a_model_of_extreme_numbers(files: dict[str, Path]) -> None:
    """Weights, cuts and alphabets at their limits: sums beyond ints, escapes that bring codes back into their range."""
    container = GridContainer(files["escapes"])
    model = container.read_model()
    rows = container.header.chunks()[0].stop
    data = container.read_chunk(container.read_table()[0])
    rng = np.random.default_rng(1)
    seen = set()
    for trial in range(12):
        groups = []
        for group in model.groups:
            # If all groups were extreme, the first one would fail each time.
            if rng.random() < 0.8:
                groups.append(group)
                continue
            cuts = tuple(
                rng.choice(np.array([-(2**31), -(2**20), -5, 0, 7, 2**25, 2**31 - 1]), len(cut)).astype(np.int32)
                for cut in group.cuts
            )
            weights = rng.choice(np.array([-32768, -300, 0, 1, 32767]), group.weights.shape).astype(np.int16)
            centre, low = (
                int(rng.choice(np.array([-(2**31), -9, 0, 2**31 - 1]))) if trial % 3 == 0 else 0 for _ in range(2)
            )
            groups.append(replace(group, cuts=cuts, weights=weights, centre=centre, low=low, shift=trial % 4 * 8))
        changed = replace(model, groups=groups)
        with kernel_of(container, changed) as kernel:
            got = kernel.codes([(rows, data)], False)[0]
        try:
            expected = decode_chunk(changed, rows, data)
        except ValueError as error:
            assert found(got) == found(error)
            seen.add(str(error))
        else:
            assert isinstance(got, ChunkCodes) and same_codes(got, expected)
    assert len(seen) > 2


def test_a_damaged_chunk_is_named(files: dict[str, Path], tmp_path: Path) -> None:
    """Through a source: the chunk, its byte and what was wrong, as without a device."""
    source = GridSource(files["layers"])
    chunk, entry = source._chunks[3], source._entries[3]
    messages = []
    for device in (False, True):
        damaged = GridSource(files["layers"])
        read = damaged.container.read_chunk
        damaged.container.read_chunk = lambda e, read=read: bytes(len(read(e))) if e == entry else read(e)  # type: ignore[method-assign]
        with pytest.raises(FormatError, match=f"{entry.section.name}.*states") as caught:
            if device:
                with damaged.on_device(open_form("w16"), 2), damaged.whole_in_order(2):
                    damaged.read_table(slice(0, chunk.stop), np.zeros((chunk.stop, 17 + 24), np.float32))
            else:
                damaged.grid()
        messages.append(str(caught.value))
    assert messages[0] == messages[1]


def test_decompress_writes_the_same_file_on_a_device(files: dict[str, Path], tmp_path: Path) -> None:
    written = {}
    for device in ("numpy", "cpu", None):
        result = decompress(files["layers"], tmp_path / f"{device}.ply", device=device)
        written[device] = (tmp_path / f"{device}.ply").read_bytes()
        assert (result.run.device is not None) == (device == "cpu")
        assert ("device" in result.run.stages) == (device == "cpu")
    assert written["numpy"] == written["cpu"] == written[None]


def test_which_device_decodes(files: dict[str, Path]) -> None:
    clock, budget = Stopwatch(), large_budget()
    source = GridSource(files["odd"])
    planes = MemorySource(from_grid(GRIDS["odd"][0]))
    assert decoder(None, source, budget, clock) is None
    assert decoder("cpu", planes, budget, clock) is None
    backend = decoder(None, source, budget, clock, source.count)
    assert backend is not None and backend.threads >= 1
    assert decoder("numpy", source, budget, clock) is None
    gpu = [DeviceInfo(0, "a", "b", "gpu", "", "", 1, 1, 1, 1, 1, 1, "ok")]
    for there in ([], gpu):
        assert decoder(None, source, budget, clock, source.count, there.copy) is None
    assert open_form("gpu").threads == open_form("numpy").threads == 0


class OnTwo(GridSource):
    """A file on a machine of two processors, which notes how many chunks a device decodes at once."""

    threads = 2

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self.asked: list[int] = []

    @contextmanager
    def on_device(self, device: Device, chunks: int) -> Iterator[None]:
        self.asked.append(chunks)
        with super().on_device(device, chunks):
            yield


def test_as_many_chunks_on_the_device_as_the_budget_allows(files: dict[str, Path]) -> None:
    source = OnTwo(files["layers"])
    backend = OpenCLBackend(replace(default_device(), compute_units=2), large_budget(), width=16)
    assert backend.threads == 2
    need, more = source.device_bytes(1), source.device_bytes(2)
    for limit in (need - 1, need, more - 1, more, 9 * more):
        with ahead(source, MemoryBudget(limit), backend):
            assert (source._kernel is not None) == (limit >= need)
    assert source.asked == [1, 1, 2, 2]


@pytest.mark.parametrize("name", ["degree 4", "layers", "one row"])
def test_work_of_decoding_stays_below_what_is_declared(name: str, files: dict[str, Path]) -> None:
    budget = WatchedBudget(1 << 40)
    source = GridSource(files[name])
    with source.on_device(OpenCLBackend(default_device(), budget, width=16), 2):
        source.read_table(slice(0, 1), np.zeros((1, 17 + source.width("sh_rest")), np.float32))
    assert budget.used == 0 and 0 < budget.most <= source.device_bytes(2)
