"""Play recorded launches back on a device, and compare every result with the twins' bits.

A record is made by `benchmarks.self_test` on the NumPy twins and lies beside this module. A kernel whose results change needs
a new one; a test says so.
"""

import contextlib
import json
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from flexgs_edge.errors import BudgetError, DeviceError
from flexgs_edge.kernels.backend import CODEC_KERNELS, Backend, TwinBackend
from flexgs_edge.memory.budget import MemoryBudget

PATTERN = 0xAB  # Every byte of a new array, so that elements that are not written are known
RECORD = Path(__file__).with_name("self_test.bin")
EXACT_ZEROS = ("dequantize", "grid_rows")
"""Kernels whose zeros must have the right sign too, since their values are written to files. Other kernels use `fma`, and some
devices give it a zero of the wrong sign: docs/devices.md#the-sign-of-zero."""


@dataclass
class Record:
    """Launches and what comes before them, in order."""

    # `["array", number, shape, dtype]`, `["write", number, offset, blob]`, `["fill", number, value, rows or None]`,
    # `["release", number]`, `["launch", kernel, size, arguments, outputs]`. An argument is a number, or `[number]` for
    # an array. An output is `[place of the argument, checksum, blob with the right values or None]`.
    steps: list[list[Any]] = field(default_factory=list)
    # What is written, and right values where no twin can give them.
    blobs: list[np.ndarray] = field(default_factory=list)

    def keep(self, values: np.ndarray) -> int:
        """Put values away; returns their number."""
        self.blobs.append(np.ascontiguousarray(values).reshape(-1).copy())
        return len(self.blobs) - 1

    @property
    def kernels(self) -> set[str]:
        """Names of all kernels that are launched."""
        return {step[1] for step in self.steps if step[0] == "launch"}

    def pack(self) -> bytes:
        """As bytes. Bytes of equal weight lie together, which compresses better."""
        head = json.dumps({"steps": self.steps, "blobs": [[b.dtype.str, b.size] for b in self.blobs]}).encode()
        body = b"".join(b.view(np.uint8).reshape(b.size, -1).T.tobytes() for b in self.blobs)
        return zlib.compress(len(head).to_bytes(4, "little") + head + body, 9)

    @classmethod
    def unpack(cls, data: bytes) -> "Record":
        """From the bytes of `pack`."""
        data = zlib.decompress(data)
        at = 4 + int.from_bytes(data[:4], "little")
        head = json.loads(data[4:at])
        blobs = []
        for kind, size in head["blobs"]:
            dtype = np.dtype(kind)
            planes = np.frombuffer(data, np.uint8, size * dtype.itemsize, at).reshape(dtype.itemsize, size)
            blobs.append(np.ascontiguousarray(planes.T).reshape(-1).view(dtype))
            at += size * dtype.itemsize
        return cls(head["steps"], blobs)


def load_record() -> Record:
    """The record that the package ships."""
    return Record.unpack(RECORD.read_bytes())


def canonical(kernel: str, values: np.ndarray) -> np.ndarray:
    """`values` with one pattern for all NaN, and zeros without a sign unless the kernel is one of `EXACT_ZEROS`."""
    if values.dtype.kind != "f":
        return values
    values = values.copy() if kernel in EXACT_ZEROS else values + values.dtype.type(0)
    values[np.isnan(values)] = np.nan
    return values


def checksum(kernel: str, values: np.ndarray) -> int:
    """CRC-32 of the bits of `canonical` values."""
    return zlib.crc32(np.ascontiguousarray(canonical(kernel, values)).view(np.uint8).reshape(-1).data)


class WrongResult(Exception):
    """A kernel gave other bits than its twin."""


class Arrays:
    """The arrays of a record on one backend, and the steps that change them."""

    def __init__(self, record: Record, backend: Backend) -> None:
        self.record, self.backend = record, backend
        self.held: dict[int, Any] = {}

    def do(self, step: list[Any]) -> None:
        """Take one step."""
        kind, name = step[:2]
        if kind == "array":
            array = self.held[name] = self.backend.array(tuple(step[2]), np.dtype(step[3]))
            self.backend.write(array, np.full(array.nbytes, PATTERN, np.uint8).view(array.dtype))
        elif kind == "write":
            self.backend.write(self.held[name], self.record.blobs[step[3]], step[2])
        elif kind == "fill":
            self.backend.fill(self.held[name], step[2], step[3])
        elif kind == "release":
            self.held.pop(name).release()
        else:
            args = [self.held[arg[0]] if isinstance(arg, list) else arg for arg in step[3]]
            self.backend.launch(name, tuple(step[2]), *args)

    def output(self, step: list[Any], place: int) -> np.ndarray:
        """The array that is the argument `place` of a launch, as it is now."""
        return self.backend.read(self.held[step[3][place][0]])

    def release(self) -> None:
        """Free what is left."""
        for array in self.held.values():
            with contextlib.suppress(Exception):  # after a failure, a runtime may refuse this as well
                array.release()


def play(record: Record, backend: Backend, watch: Callable[[str], None] = lambda kernel: None) -> None:
    """Play `record` on `backend`. A device without threads is spared the kernels of the coder, which no run starts there.

    Raises `WrongResult` with the kernel, the first wrong value, and what was expected. Raises `DeviceError,
    BudgetError` : From the backend.
    """
    arrays, seen = Arrays(record, backend), set[str]()
    try:
        for number, step in enumerate(record.steps):
            if step[0] != "launch":
                arrays.do(step)
                continue
            name = step[1]
            if name in CODEC_KERNELS and not backend.threads:
                continue
            if name not in seen:
                seen.add(name)
                watch(name)
            arrays.do(step)
            for place, wanted, _ in step[4]:
                got = arrays.output(step, place)
                if checksum(name, got) != wanted:
                    raise WrongResult(_explain(record, number, place, got))
    finally:
        arrays.release()


def _explain(record: Record, number: int, place: int, got: np.ndarray) -> str:
    """One line about the first wrong value of a launch."""
    _, name, size, _, outputs = record.steps[number]
    expected = _expected(record, number, place, outputs)
    got, expected = (canonical(name, values).reshape(-1) for values in (got, expected))
    raw = f"u{got.dtype.itemsize}"
    wrong = np.flatnonzero(got.view(raw) != expected.view(raw))
    where = f"argument {place + 1}, launch {number} over {'x'.join(map(str, size))}"
    if not len(wrong):  # the record does not fit the twins: a fault of ours
        return f"kernel {name} ({where}): the checksum of the self-test is out of date"
    first = int(wrong[0])
    return (
        f"kernel {name} computes {_shown(got[first])} where {_shown(expected[first])} is right "
        f"(element {first}, the first of {len(wrong)} wrong ones; {where})"
    )


def _expected(record: Record, number: int, place: int, outputs: list[Any]) -> np.ndarray:
    blob = next(blob for at, _, blob in outputs if at == place)
    if blob is not None:
        return record.blobs[blob]
    twins = Arrays(record, TwinBackend(MemoryBudget(1 << 40)))
    for step in record.steps[: number + 1]:
        if step[0] != "launch" or step[1] not in CODEC_KERNELS:
            twins.do(step)
    return twins.output(record.steps[number], place)


def _shown(value: Any) -> str:
    return f"{value:.9g}" if isinstance(value, np.floating) else str(value)


def verdict(record: Record, backend: Backend, watch: Callable[[str], None] = lambda kernel: None) -> str:
    """`ok`, or one line about the first fault."""
    try:
        play(record, backend, watch)
    except WrongResult as error:
        return str(error)
    except (DeviceError, BudgetError) as error:
        return first_words(str(error))
    return "ok"


def first_words(message: str) -> str:
    """A message of many lines as one: its first line, and the first that tells of an error."""
    lines = [line.strip() for line in message.splitlines() if line.strip()]
    reasons = [line for line in lines[1:] if "error" in line.lower()]
    return " ".join([*lines[:1], *reasons[:1]])[:400]
