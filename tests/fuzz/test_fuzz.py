"""A part of the fuzzing of benchmarks/fuzz.py with every test run, and a folder of files that must be refused."""

from __future__ import annotations

import random
import time
import tracemalloc
from pathlib import Path

import pytest

from benchmarks.damage import mutate_bytes, mutate_json, mutate_sealed, mutate_text
from benchmarks.fuzz import BOUND, KINDS, SEEDS, SLOW, Fuzzer, Kind, fuzz, read_container, read_other, read_views
from flexgs_edge.codec.open_fgs import verify
from flexgs_edge.errors import FlexGSError
from flexgs_edge.io.formats import format_of
from flexgs_edge.io.ply import PlySource
from flexgs_edge.scene.check import check_scene

CORPUS = Path(__file__).parent / "corpus"
TRIES = {"v1 plain": 1500, "v2 plain": 1000, "v1 sealed": 300, "v2 sealed": 150, "v2 sealed, its preview": 150}


def read(place: Path) -> object:
    """As a command would."""
    if place.suffix == ".fgs":
        return read_container(place)
    if format_of(place) is not None:
        return read_other(place)
    return check_scene(PlySource(place)) if place.suffix == ".ply" else read_views(place)


@pytest.mark.parametrize("name", sorted(place.name for place in CORPUS.iterdir()))
def test_the_corpus_is_refused(name: str) -> None:
    """Soon, in little memory, and by an error of ours that names the file (of a COLMAP model, one in the folder)."""
    tracemalloc.start()
    started = time.thread_time()
    with pytest.raises(FlexGSError) as caught:
        read(CORPUS / name)
    seconds, peak = time.thread_time() - started, tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert name in str(caught.value) and len(str(caught.value)) < 1000
    assert seconds < SLOW and peak < BOUND


def test_seeds_are_read_as_they_are() -> None:
    for name in (
        "v1.fgs",
        "v2.fgs",
        "v2_preview.fgs",
        "binary.ply",
        "ascii.ply",
        "big.ply",
        "cameras.json",
        "transforms.json",
        "text",
        "binary",
        "first.spz",
        "second.spz",
        "third.spz",
        "fourth.spz",
        "tiny.splat",
        "plain.ksplat",
        "packed.ksplat",
        "tiny.compressed.ply",
    ):
        assert read(SEEDS / name)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_mutations(kind: Kind, tmp_path: Path) -> None:
    """The first tries of each kind, the same in every run."""
    tally = fuzz(kind, 0, TRIES.get(kind.name, 500), keep=tmp_path / "failed")
    assert tally.failures == []
    if "plain" in kind.name:
        assert tally.outcomes == {"refused": tally.tries}  # every change is found
    else:
        assert tally.outcomes["refused"] > tally.tries // 4 and tally.outcomes["read"] > 5
    assert not (tmp_path / "failed").exists()


def test_tries_can_be_made_again(tmp_path: Path) -> None:
    kind = KINDS[2]
    fuzzers = [Fuzzer(kind, tmp_path / name) for name in ("a", "b")]
    made = [[fuzzer.made(number) for number in range(50)] for fuzzer in fuzzers]
    assert made[0] == made[1]
    assert len({data for _, data in made[0]}) > 45


def test_sealed_changes_pass_the_checksums() -> None:
    """Otherwise the decoders would never meet them."""
    for name in ("v1.fgs", "v2.fgs"):
        data, sections = (SEEDS / name).read_bytes(), verify(SEEDS / name)
        place = Path(SEEDS / name)
        fuzzer_sees = 0
        for number in range(60):
            changed = mutate_sealed(random.Random(number), data, sections)
            fuzzer_sees += changed != data
            assert changed[:8] == data[:8] and len(changed) >= 36
        assert fuzzer_sees > 50 and place.read_bytes() == data


def test_faults_would_be_seen(tmp_path: Path) -> None:
    """A reader that crashes, passes damage, takes long, or allocates what a file asks for: each fails its tries."""

    def crash(place: Path) -> str:
        raise KeyError(place.name)

    def slow(place: Path) -> str:
        end = time.thread_time() + 1.2
        while time.thread_time() < end:
            pass
        return "read"

    def greedy(place: Path) -> str:
        return "read" if bytearray(BOUND + (1 << 26)) else ""

    faults = {"KeyError": crash, "did not find": lambda place: "missed", "took 1": slow, "allocated": greedy}
    for words, reader in faults.items():
        kind = Kind("PLY", ("binary.ply",), mutate_text, reader, 1)
        fuzzer = Fuzzer(
            Kind("PLY", ("binary.ply",), mutate_text, lambda place: "read", 1), tmp_path / words.replace(" ", "")
        )
        fuzzer.kind = kind
        fuzzer.run(3, traced=words == "allocated")
        assert len(fuzzer.tally.failures) == 1 and words in fuzzer.tally.failures[0]


@pytest.mark.parametrize("mutate", [mutate_bytes, mutate_text, mutate_json])
def test_mutations_change_things(mutate: object) -> None:
    data = (SEEDS / "cameras.json").read_bytes()
    made = {mutate(random.Random(number), data) for number in range(200)}  # type: ignore[operator]
    assert len(made) > 170
