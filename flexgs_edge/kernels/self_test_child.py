"""Test one device in a process of its own: `python -m flexgs_edge.kernels.self_test_child INDEX NAME FORM...`.

Forms that are named are left out. Prints the name of each form and kernel before it is built, and the verdict as JSON at the end.
"""

import contextlib
import json
import resource
import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels.choose_device import DeviceInfo, Form, list_devices, possible_forms, probed
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.self_test import first_words, load_record, verdict
from flexgs_edge.kernels.tested import FORM, MARK, Verdict
from flexgs_edge.memory.budget import MemoryBudget

KERNEL = "blend_stats"
"""The kernel that is timed. Blends take most of the time of a run, and this one makes a program of its own, which builds fast."""
TILES_ACROSS = 6
SPLATS = 64  # Splats of a tile: two batches, few enough for devices that end loops
LAPS = 3  # Timed launches of each form, after one that may still compile


@dataclass(frozen=True)
class Measured:
    """A form, the backend that has it, and seconds of a launch."""

    form: Form
    backend: OpenCLBackend
    seconds: float


def measure_forms(
    info: DeviceInfo, without: Collection[str] = (), say: Callable[[str], None] = lambda name: None
) -> tuple[list[Measured], str]:
    """Time all forms that the device can take; returns them, the fastest first, and why the first of the others failed."""
    found: list[Measured] = []
    failed = ""
    written = False
    for number, form in enumerate(possible_forms(info)):
        both = [form, replace(form, written_fma=True)]
        # What is faster for the first form is so for all; building the slow ones takes long.
        chosen = both if number == 0 or not found else [both[written]]
        tried = chosen if may_write_fma(info) else both[:1]
        for one in tried:
            if str(one) in without:
                continue
            say(str(one))
            try:
                backend = OpenCLBackend(replace(info, form=str(one)), MemoryBudget(1 << 40))
                found.append(Measured(one, backend, _seconds(backend)))
            except (DeviceError, BudgetError) as error:
                failed = failed or str(error)
        found.sort(key=lambda measured: measured.seconds)
        written = bool(found) and found[0].form.written_fma
    return found, failed


def may_write_fma(info: DeviceInfo) -> bool:
    """Whether the device has no `fma` of its own, and no subnormal numbers either, whose bits the written one would change."""
    import pyopencl as cl

    own = cl.device_fp_config.FMA | cl.device_fp_config.DENORM
    return info.handle is not None and not info.handle.single_fp_config & own


def _seconds(backend: OpenCLBackend) -> float:
    """Seconds of the fastest launch that blends a small picture."""
    random = np.random.default_rng(1)
    tiles, side = TILES_ACROSS**2, TILES_ACROSS * 16
    count = tiles * SPLATS
    tile = np.repeat(np.arange(tiles), SPLATS)
    records = np.zeros((count, 16), np.float32)
    records[:, 0] = tile % TILES_ACROSS * 16 + random.uniform(0, 16, count)
    records[:, 1] = tile // TILES_ACROSS * 16 + random.uniform(0, 16, count)
    records[:, 2] = records[:, 4] = 0.02
    records[:, 5] = -4  # log2 of the opacity: no pixel ends
    records[:, 6:9] = 0.5
    pairs = np.stack([np.arange(count), np.full(count, 0xFFFF)], axis=1).astype(np.uint32)
    ends = ((np.arange(tiles) + 1) * SPLATS).astype(np.uint32)
    given = [ends, pairs, records, np.zeros((tiles, 4, 256), np.float32), np.zeros((3, side, side), np.float32)]
    given += [np.zeros(count, np.uint32), np.zeros((count, 2), np.uint32)]
    arrays = []
    try:
        for values in given:
            arrays.append(backend.array(values.shape, values.dtype))
            backend.write(arrays[-1], values)
        laps = []
        for _ in range(1 + LAPS):
            start = time.perf_counter()
            backend.launch(KERNEL, (tiles,), TILES_ACROSS, 1, side, side, 0, 1, 0.0, 0.0, 0.0, *arrays)
            backend.mark()()
            laps.append(time.perf_counter() - start)
        return min(laps[1:])
    finally:
        for array in arrays:
            array.release()


def test(index: int, name: str, without: Sequence[str] = ()) -> Verdict:
    """Test the device with this index; another name means that devices came or went.

    The fastest form of the kernels is taken that gives the right bits. If none is left to try, the verdict says nothing.
    """
    devices = list_devices(self_test=False)
    if index >= len(devices) or devices[index].name != name:
        return Verdict(f"the device is gone: [{index}] is no longer {name}")
    info = probed(devices[index])
    if not info.usable:
        return Verdict(info.self_test)
    measured, failed = measure_forms(info, without, lambda form: _say(f"{FORM}{form}"))
    record = load_record()
    reasons = [first_words(failed)]
    for one in measured:
        _say(f"{FORM}{one.form}")
        said = verdict(record, one.backend, _say)
        if said == "ok":
            return Verdict(said, info.loop_steps, str(one.form))
        reasons.append(said)
    return Verdict(next(filter(None, [*reasons[1:], reasons[0]]), ""), info.loop_steps)


def _say(text: str) -> None:
    print(f"{MARK}{text}", flush=True)


if __name__ == "__main__":
    with contextlib.suppress(OSError, ValueError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    _say(json.dumps(asdict(test(int(sys.argv[1]), sys.argv[2], sys.argv[3:]))))
