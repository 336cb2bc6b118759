"""Makes the record of the self-test, and shows which planted faults it sees.

python -m benchmarks.self_test record           # after a kernel's results have changed: writes flexgs_edge/kernels/self_test.bin
python -m benchmarks.self_test check            # whether the twins, and all forms of the kernels, give the record
python -m benchmarks.self_test mutations        # one operator changed at a time
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.self_test_faults import faults, judge, judge_all
from benchmarks.self_test_scene import BLOCKS, code_all, draw_all
from flexgs_edge.kernels.backend import CODEC_KERNELS, KERNELS, TwinBackend
from flexgs_edge.kernels.choose_device import Form, choose_device, list_devices
from flexgs_edge.kernels.opencl import OpenCLBackend
from flexgs_edge.kernels.self_test import PATTERN, RECORD, Arrays, Record, checksum, load_record, verdict
from flexgs_edge.memory.budget import MemoryBudget

LEAST_REFUSED = 0.95
"""Share of the faults that the self-test must refuse."""
FORMS = {
    "w16": (16, "cpu"),
    "w8": (8, "cpu"),
    "w4": (4, "cpu"),
    "w1": (1, "cpu"),
    "gpu": (1, "gpu"),
    "gpu4": (4, "gpu"),
    "fma": (4, "gpu"),
}


class Recorder:
    """A backend that notes what it is asked for, on top of one that does it."""

    def __init__(self, backend: Any, record: Record) -> None:
        self.backend, self.record = backend, record
        self.sort_blocks = self.tile_blocks = BLOCKS
        self.changed: dict[str, set[int]] = {}
        self._numbers: dict[int, int] = {}
        self._next = max((step[1] for step in record.steps if step[0] == "array"), default=-1) + 1
        self._after: list[tuple[list[Any], list[np.ndarray | None], set[int]]] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self.backend, name)

    def array(self, shape: tuple[int, ...], dtype: Any) -> Any:
        """A new array, full of the pattern of the self-test."""
        array = self.backend.array(shape, dtype)
        self.backend.write(array, np.full(array.nbytes, PATTERN, np.uint8).view(array.dtype))
        self._numbers[id(array)], self._next = self._next, self._next + 1
        self.record.steps.append(["array", self._numbers[id(array)], [int(n) for n in shape], np.dtype(dtype).str])
        let_go = array.release

        def release() -> None:
            if id(array) in self._numbers:
                self.record.steps.append(["release", self._numbers.pop(id(array))])
            let_go()

        array.release = release
        return array

    def write(self, array: Any, values: np.ndarray, offset: int = 0, stays: bool = False) -> None:
        """Write, and note it."""
        self.backend.write(array, values, offset)
        values = np.ascontiguousarray(values, array.dtype)
        if values.size:
            self.record.steps.append(["write", self._numbers[id(array)], int(offset), self.record.keep(values)])

    @contextmanager
    def mapped(self, array: Any) -> Iterator[np.ndarray]:
        """Write on the host, and note it."""
        values = np.empty(array.shape, array.dtype)
        yield values
        self.write(array, values)

    def fill(self, array: Any, value: int, count: int | None = None) -> None:
        """Fill, and note it."""
        self.backend.fill(array, value, count)
        self.record.steps.append(["fill", self._numbers[id(array)], int(value), count if count is None else int(count)])

    def launch(self, name: str, size: tuple[int, ...], *args: Any) -> None:
        """Launch, and note arguments and results."""
        spec = KERNELS.get(name) or CODEC_KERNELS[name]
        before = [
            self.backend.read(arg) if kind == "b" else None for kind, arg in zip(spec.signature, args, strict=True)
        ]
        self.backend.launch(name, size, *args)
        after = [
            self.backend.read(arg) if kind == "b" else None for kind, arg in zip(spec.signature, args, strict=True)
        ]
        plain = [
            [self._numbers[id(arg)]] if kind == "b" else float(np.float32(arg)) if kind == "f" else int(arg)
            for kind, arg in zip(spec.signature, args, strict=True)
        ]
        step: list[Any] = ["launch", name, [int(n) for n in size], plain, []]
        self.record.steps.append(step)
        changed = self.changed.setdefault(name, set())
        for place, (one, two) in enumerate(zip(before, after, strict=True)):
            if one is not None and two is not None and one.tobytes() != two.tobytes():
                changed.add(place)
        if name in CODEC_KERNELS:  # what an argument is depends on the task
            self.changed[name] = set()
        self._after.append((step, after, changed))

    def finish(self, with_values: bool = False) -> None:
        """Add checksums of every argument that the kernel changed in any launch."""
        for step, after, changed in self._after:
            for place in sorted(changed):
                values = after[place]
                assert values is not None
                if any(other < place and step[3][other] == step[3][place] for other in changed):
                    continue
                step[4].append([place, checksum(step[1], values), self.record.keep(values) if with_values else None])


def make_record() -> Record:
    """Record everything: what draws on the twins, and what codes on the first processor, after NumPy has agreed."""
    record = Record()
    twins = Recorder(TwinBackend(MemoryBudget(1 << 40)), record)
    draw_all(twins)
    twins.finish()
    coder = Recorder(open_form("w16"), record)
    code_all(coder)
    coder.finish(with_values=True)
    left_out = unsteady(record)
    for step in record.steps:
        if step[0] == "launch":
            step[4] = [output for output in step[4] if (step[1], output[0]) not in left_out]
    return compact(record)


def compact(record: Record) -> Record:
    """Without blobs that nothing names, and each blob once."""
    made, places = Record(record.steps), dict[tuple[str, bytes], int]()

    def place(number: int) -> int:
        blob = record.blobs[number]
        key = blob.dtype.str, blob.tobytes()
        if key not in places:
            places[key] = made.keep(blob)
        return places[key]

    for step in made.steps:
        if step[0] == "write":
            step[3] = place(step[3])
        elif step[0] == "launch":
            for output in step[4]:
                output[2] = output[2] if output[2] is None else place(output[2])
    return made


def unsteady(record: Record) -> set[tuple[str, int]]:
    """Outputs of the coder's kernels that differ between widths: work space, whose last lanes nobody reads."""
    found = set()
    for form in ("w8", "w4", "w1"):
        backend = open_form(form)
        player = Arrays(record, backend)
        for step in record.steps:
            if step[0] == "launch" and step[1] not in CODEC_KERNELS:
                continue
            player.do(step)
            if step[0] == "launch":
                found |= {(step[1], p) for p, crc, _ in step[4] if checksum(step[1], player.output(step, p)) != crc}
        player.release()
    return found


def open_form(form: str, spec: str | None = None) -> OpenCLBackend:
    """A form of the kernels on the default device, or on the one that `spec` names."""
    info = choose_device(spec, list_devices())[0]
    width, shape = FORMS[form]
    kind = Form(shape, width, written_fma=form == "fma")
    return OpenCLBackend(replace(info, compute_units=1, form=str(kind)), MemoryBudget(1 << 40))


def check(record: Record) -> int:
    """Play the record on the twins and on every form; returns 1 if one gives other bits."""
    wrong = 0
    for form in ("numpy", *FORMS):
        backend: Any = TwinBackend(MemoryBudget(1 << 40)) if form == "numpy" else open_form(form)
        for lap in ("first", "again"):
            start = time.perf_counter()
            said = verdict(record, backend)
            print(f"{form}, {lap}: {said} ({time.perf_counter() - start:.2f} s)", flush=True)
            if form == "numpy":
                break
        wrong |= said != "ok"
    return int(wrong)


REASONS = {
    ("blend_cpu.cl", "any_alive", ">"): "a transmittance is never 0: pixels end before",
    ("backward.cl", "project_backward", ">"): "at equality the quotient is 1, as without it",
    ("flip.cl", "flip_pair", "<"): "both pieces of the curve meet there",
    ("sort.cl", "exclusive_scan", "<"): "one turn more, in which no block is left",
    ("common.clh", "smaller", "<"): "of two equal numbers it does not matter which is taken",
    ("common.clh", "larger", ">"): "of two equal numbers it does not matter which is taken",
    ("common.clh", "fexp2", "<"): "of two equal numbers it does not matter which is taken",
    (
        "project.cl",
        "project",
        "<=",
    ): "a splat that ends at the picture's edge, to the last bit, reaches no tile in either case",
    ("tiles.cl", "tile_row", "<"): "of two equal numbers it does not matter which is taken",
}
"""Why faults pass, by file, function and changed line."""


def mutations(only: str | None, workers: int, verbose: bool) -> int:
    """Plant every fault; returns 1 if fewer are refused than asked for."""
    chosen = [fault for fault in faults() if only is None or only in f"{fault.file} {fault.function}"]
    with tempfile.TemporaryDirectory(prefix="self-test-") as name:
        for form in FORMS:
            healthy = judge(None, Path(name) / "0", (form,))
            if healthy[1] != "passed":
                print(f"the self-test refuses sound kernels: {healthy}", file=sys.stderr)
                return 2
        rows = judge_all(chosen, Path(name), workers, verbose)
    passed = [fault for fault, _, said in rows if said == "passed"]
    share = 1 - len(passed) / max(len(rows), 1)
    print(f"{len(rows)} faults, {len(rows) - len(passed)} refused ({share:.1%})")
    for fault in passed:
        why = REASONS.get((fault.file, fault.function, fault.old), "unknown")
        print(f"  {fault.file}:{fault.line} {fault.function}: {fault.words()}: {why}")
    return int(share < LEAST_REFUSED)


def main() -> int:
    """Record, check or mutate."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("record", "check", "mutations", "play"))
    parser.add_argument("--form", default="w16", choices=FORMS, help="for play: the form of the kernels")
    parser.add_argument("--only", metavar="WORD", help="for mutations: files and functions with this word")
    parser.add_argument("--workers", type=int, default=1, help="for mutations: faults judged side by side")
    parser.add_argument("-v", "--verbose", action="store_true", help="for mutations: a line for each fault")
    options = parser.parse_args()
    if options.what == "play":
        print(verdict(load_record(), open_form(options.form)))
        return 0
    if options.what == "mutations":
        return mutations(options.only, options.workers, options.verbose)
    if options.what == "record":
        record = make_record()
        missing = {*KERNELS, *CODEC_KERNELS} - record.kernels
        if missing:
            print(f"not launched: {', '.join(sorted(missing))}", file=sys.stderr)
            return 1
        RECORD.write_bytes(record.pack())
        launches = sum(step[0] == "launch" for step in record.steps)
        print(f"{RECORD}: {RECORD.stat().st_size} bytes, {launches} launches")
    return check(load_record())


if __name__ == "__main__":
    sys.exit(main())
