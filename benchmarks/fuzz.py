"""Fuzzes all readers: every mutated file must raise an error of ours or be read as valid values.

    python -m benchmarks.fuzz                          # a million: 8 processor minutes
    python -m benchmarks.fuzz --part 0.1               # a tenth of it
    python -m benchmarks.fuzz --tries 2000 --only v2   # 2000 of one kind

Every try has a number, which is the seed of its random choices: `--from N --tries 1` repeats one. Mutations of containers
are of two kinds. `verify` must find all *plain* ones. *Sealed* ones have corrected checksums, so that they reach the
decoders; these must return finite values or raise an error of ours.
"""

from __future__ import annotations

import argparse
import contextlib
import random
import shutil
import signal
import sys
import tempfile
import time
import traceback
import tracemalloc
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from benchmarks.damage import (
    mutate_bytes,
    mutate_glb,
    mutate_json,
    mutate_preview,
    mutate_sealed,
    mutate_sparse,
    mutate_spz,
    mutate_text,
    mutate_zipped_json,
    mutate_zipped_piece,
)
from benchmarks.harness import ROOT
from flexgs_edge.cameras.read import read_cameras
from flexgs_edge.codec.open_fgs import open_fgs, read_header, verify
from flexgs_edge.codec.v2.container import GridContainer, Preview
from flexgs_edge.codec.v2.grid_source import GridSource
from flexgs_edge.errors import FlexGSError, FormatError
from flexgs_edge.io.exchange import read_foreign
from flexgs_edge.io.ply import PlySource
from flexgs_edge.memory.process import peak_rss
from flexgs_edge.scene.check import check_scene
from flexgs_edge.scene.fields import FIELDS
from flexgs_edge.scene.source import SceneSource

SEEDS = ROOT / "tests" / "fuzz" / "seeds"
"""Small valid files that mutations start from."""
SLOW = 1.0
"""Most processor seconds of a try."""
STUCK = 20.0
"""Processor seconds after which a run of 32 tries gives up its present try."""
TRACED_EVERY = 100
"""Allocations are traced in one of this many tries, because tracing is slow."""
BOUND = 12 << 20
"""Bytes that reading any file may allocate. Most of them are for the decoder's tables."""
ROW_BOUND = 4096
"""Further bytes for each row, for as many rows as the file's size allows."""


def read_all(source: SceneSource) -> str:
    """Read every value of a scene. Returns `read`, or `left out` if some rows are invalid."""
    planes = source.read(slice(0, source.count), [field.name for field in FIELDS])
    good = all(bool(np.isfinite(plane).all()) for plane in planes.values())
    check_scene(source, drop_invalid=True)
    return "read" if good else "left out"


def read_container(place: Path) -> str:
    """Decode a `.fgs` and check that its values are finite."""
    source = open_fgs(place)
    outcome = read_all(source)
    if outcome != "read":
        raise AssertionError("a .fgs gave values that are not finite")
    return outcome


def read_preview(place: Path) -> str:
    """Decode the preview of a `.fgs`, and check that its values are finite."""
    outcome = read_all(GridSource(place, Preview(GridContainer(place))))
    if outcome != "read":
        raise AssertionError("a preview gave values that are not finite")
    return outcome


def read_ply(place: Path) -> str:
    """Read a PLY."""
    return read_all(PlySource(place))


def read_other(place: Path) -> str:
    """Read a scene in another program's format."""
    return read_all(read_foreign(place))


def read_views(place: Path) -> str:
    """Read cameras twice: strictly, and with distortion ignored."""
    cameras = read_cameras(place, ignore_distortion=True)
    for camera in cameras:
        values = np.concatenate(
            [camera.rotation.ravel(), camera.translation, [camera.fx, camera.fy, camera.cx, camera.cy]]
        )
        if not np.isfinite(values).all() or camera.width < 1 or camera.height < 1:
            raise AssertionError(f"camera {camera.name!r} is not finite")
    return "read"


def find(place: Path) -> str:
    """Run `verify`. Returns `missed` if it passes a damaged file that can be read."""
    verify(place)
    return "missed"


@dataclass(frozen=True)
class Kind:
    """A kind of mutation: the files, the changes, and the reader.

    Parameters
    ----------
    name : str
        Name in the table and for `--only`.
    seeds : tuple of str
        Files in `SEEDS`. Of a COLMAP model one file is changed, and its folder is read.
    mutate : callable
        Makes a file's bytes from a seed's. For sealed kinds it also gets the sections.
    read : callable
        Reads the file; returns a word for the outcome, or raises.
    sealed : bool
        Whether checksums of the mutated container are corrected.
    tries : int
        Tries of a whole run.
    folder : bool
        Whether the reader gets the file's folder instead of the file.
    """

    name: str
    seeds: tuple[str, ...]
    mutate: Callable[..., bytes]
    read: Callable[[Path], str]
    tries: int
    sealed: bool = False
    folder: bool = False


KINDS = (
    Kind("v1 plain", ("v1.fgs",), mutate_bytes, find, 540_000),
    Kind("v2 plain", ("v2.fgs",), mutate_bytes, find, 440_000),
    Kind("v1 sealed", ("v1.fgs",), mutate_sealed, read_container, 16_000, sealed=True),
    Kind("v2 sealed", ("v2.fgs",), mutate_sealed, read_container, 4_000, sealed=True),
    Kind("v2 plain, with a preview", ("v2_preview.fgs",), mutate_bytes, find, 40_000),
    Kind("v2 sealed, its preview", ("v2_preview.fgs",), mutate_preview, read_preview, 4_000, sealed=True),
    Kind("PLY", ("binary.ply", "ascii.ply", "big.ply"), mutate_text, read_ply, 20_000),
    Kind("cameras.json, transforms.json", ("cameras.json", "transforms.json"), mutate_json, read_views, 10_000),
    Kind("COLMAP", ("text/cameras.txt", "text/images.txt", "binary/cameras.bin", "binary/images.bin"), mutate_text, read_views,
         10_000, folder=True),
    Kind("glTF", ("splats.gltf",), mutate_json, read_other, 100_000),
    Kind("GLB", ("splats.glb",), mutate_bytes, read_other, 100_000),
    Kind("repacked GLB", ("splats.glb",), mutate_glb, read_other, 100_000),
    Kind("SPZ", ("first.spz", "second.spz", "third.spz", "fourth.spz"), mutate_bytes, read_other, 100_000),
    Kind("SPZ, repacked", ("first.spz", "second.spz", "third.spz", "fourth.spz"), mutate_spz, read_other, 100_000),
    Kind("splat", ("tiny.splat",), mutate_bytes, read_other, 100_000),
    Kind("ksplat", ("plain.ksplat", "packed.ksplat"), mutate_sparse, read_other, 100_000),
    Kind("compressed PLY", ("tiny.compressed.ply",), mutate_text, read_other, 100_000),
    Kind("SOG zip", ("version2.sog", "version1.sog"), mutate_bytes, read_other, 100_000),
    Kind("SOG meta.json", ("version2.sog", "version1.sog"), mutate_zipped_json, read_other, 100_000),
    Kind("SOG pictures", ("version2.sog", "version1.sog"), mutate_zipped_piece, read_other, 100_000),
    Kind("lod-meta.json", ("streamed/lod-meta.json",), mutate_json, read_other, 100_000),
)  # fmt: skip


@dataclass
class Tally:
    """Outcomes of the tries of one kind."""

    kind: Kind
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    slowest: float = 0.0
    most_bytes: int = 0
    most_over: float = 0.0
    """Largest traced allocation, as a share of the file's bound."""

    @property
    def tries(self) -> int:
        """Files read."""
        return sum(self.outcomes.values())


class Fuzzer:
    """Makes and reads the mutations of one kind, in its own folder.

    Parameters
    ----------
    kind : Kind
        What to mutate.
    folder : path
        A folder in memory is best, because each try writes a file.
    """

    def __init__(self, kind: Kind, folder: Path) -> None:
        self.kind, self.tally = kind, Tally(kind)
        self.seeds = [(SEEDS / name).read_bytes() for name in kind.seeds]
        self.sections = [tuple(verify(SEEDS / name)) if kind.sealed else () for name in kind.seeds]
        self.places = []
        for name in kind.seeds:
            place = folder / name
            shutil.copytree((SEEDS / name).parent, place.parent, dirs_exist_ok=True)
            # This also imports everything before allocations are counted.
            outcome = kind.read(place.parent if kind.folder else place)
            if outcome not in ("read", "missed"):
                raise AssertionError(f"{SEEDS / name} is not as it should be: {outcome}")
            self.places.append(place)

    def made(self, number: int) -> tuple[int, bytes]:
        """The number of the seed that a try starts from, and its mutation."""
        draw = random.Random(f"{self.kind.name} {number}")
        index = draw.randrange(len(self.seeds))
        seed = self.seeds[index]
        for _ in range(8):
            data = self.kind.mutate(draw, seed, *([self.sections[index]] if self.kind.sealed else []))
            if data != seed:
                break
        return index, data

    def run(self, number: int, traced: bool = False) -> str:
        """Make one try; returns the outcome and adds it to the tally."""
        index, data = self.made(number)
        place = self.places[index]
        place.write_bytes(data)
        if traced:
            tracemalloc.start()
        started = time.perf_counter()
        try:
            outcome = self._read(place)
        except FlexGSError as error:
            outcome = "refused"
            if str(place.name) not in str(error) and not self.kind.folder:
                self._fail(number, f"an error that does not name the file: {error}")
        except Exception:
            outcome = "crashed"
            self._fail(number, traceback.format_exc())
        seconds = time.perf_counter() - started
        if traced:
            self._weigh(number, place, tracemalloc.get_traced_memory()[1])
            tracemalloc.stop()
        elif seconds > self.tally.slowest:
            # Either the machine is busy or the try is slow. Measure processor time now; always asking for it would cost too much.
            self.tally.slowest = max(self.tally.slowest, seconds := self._processor_seconds(place))
            if seconds > SLOW:
                self._fail(number, f"took {seconds:.2f} s")
        if self.kind.folder:
            place.write_bytes(self.seeds[index])
        if outcome == "missed" and data != self.seeds[index]:
            self._fail(number, "a change that `verify` did not find")
        self.tally.outcomes[outcome] += 1
        return outcome

    def _read(self, place: Path) -> str:
        return self.kind.read(place.parent if self.kind.folder else place)

    def _processor_seconds(self, place: Path) -> float:
        started = time.thread_time()
        with contextlib.suppress(Exception):
            self._read(place)
        return time.thread_time() - started

    def _weigh(self, number: int, place: Path, peak: int) -> None:
        rows = 16 * place.stat().st_size
        if self.kind.sealed:
            try:
                rows = read_header(place).count
            except FormatError:
                rows = 0
        allowed = BOUND + ROW_BOUND * rows
        self.tally.most_bytes = max(self.tally.most_bytes, peak)
        self.tally.most_over = max(self.tally.most_over, peak / allowed)
        if peak > allowed:
            self._fail(number, f"allocated {peak} bytes where {rows} rows allow {allowed}")

    def _fail(self, number: int, words: str) -> None:
        self.tally.failures.append(f"{self.kind.name}, try {number}: {words}")


def _stuck(number: int, frame: object) -> None:
    raise TimeoutError(f"no end after {STUCK:g} s")


def fuzz(kind: Kind, first: int, tries: int, keep: Path | None = None) -> Tally:
    """Make tries of one kind, numbered from `first`. Files that fail are copied to the folder `keep`."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as name, warnings.catch_warnings():
        signal.signal(signal.SIGVTALRM, _stuck)
        warnings.simplefilter("error")  # a warning means an overflow that nobody thought of
        fuzzer = Fuzzer(kind, Path(name))
        for number in range(first, first + tries):
            if number % 32 == 0:
                signal.setitimer(signal.ITIMER_VIRTUAL, STUCK)
            before = len(fuzzer.tally.failures)
            fuzzer.run(number, number % TRACED_EVERY == 0)
            if len(fuzzer.tally.failures) > before and keep is not None:
                keep.mkdir(parents=True, exist_ok=True)
                index, data = fuzzer.made(number)
                (keep / f"{kind.name.split()[0]}-{number}-{Path(kind.seeds[index]).name}").write_bytes(data)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
    return fuzzer.tally


HEAD = """
| what | tries | refused | read | not found | crashes, warnings | over {slow:g} s | slowest | most allocated | of its bound |
|---|---|---|---|---|---|---|---|---|---|
"""
TAIL = """
{containers} of the tries were of containers; {found} of {plain} plain changes were found. All of it took {minutes:.1f} processor
minutes, and the process never held more than {peak:.0f} MiB. Times are processor time of one try. Allocations are traced on one
try in {every}; the bound is {fixed} MiB and {row} bytes for each row that the checked header says or the file's size allows.
"""


def table(tallies: Sequence[Tally], minutes: float) -> str:
    """The table of a run."""
    lines = []
    for tally in tallies:
        slow = sum("took" in words for words in tally.failures)
        got = tally.outcomes
        read = got["read"] + got["left out"]
        lines.append(
            f"| {tally.kind.name} | {tally.tries} | {got['refused']} | {read} | {got['missed']} | {got['crashed']} | {slow} | "
            f"{1000 * tally.slowest:.0f} ms | {tally.most_bytes / 1e6:.2f} MB | {100 * tally.most_over:.0f} % |"
        )
    containers = [tally for tally in tallies if tally.kind.name.startswith("v")]
    plain = [tally for tally in containers if not tally.kind.sealed]
    tail = TAIL.format(
        containers=sum(tally.tries for tally in containers),
        found=sum(tally.outcomes["refused"] for tally in plain),
        plain=sum(tally.tries for tally in plain),
        minutes=minutes,
        peak=peak_rss() / 2**20,
        every=TRACED_EVERY,
        fixed=BOUND >> 20,
        row=ROW_BOUND,
    )
    return HEAD.format(slow=SLOW) + "\n".join(lines) + "\n" + tail


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tries", type=int, help="of each kind; default: as many as the table has")
    parser.add_argument("--part", type=float, default=1.0, help="of the table's tries; default: all")
    parser.add_argument("--from", type=int, default=0, dest="first", help="number of the first one; default: 0")
    parser.add_argument("--only", default="", help="kinds whose name begins so")
    parser.add_argument("--keep", type=Path, help="folder for files that failed")
    options = parser.parse_args()
    started = time.process_time()
    tallies = []
    for kind in KINDS:
        if not kind.name.startswith(options.only):
            continue
        tally = fuzz(kind, options.first, options.tries or round(options.part * kind.tries), keep=options.keep)
        tallies.append(tally)
        print(f"{kind.name}: {tally.tries} tries, {dict(tally.outcomes)}", file=sys.stderr, flush=True)
        print("\n".join(tally.failures), end="\n" if tally.failures else "", file=sys.stderr, flush=True)
    print(table(tallies, (time.process_time() - started) / 60))
    return int(any(tally.failures for tally in tallies))


if __name__ == "__main__":
    sys.exit(main())
