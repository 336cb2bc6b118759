"""The decoder in JavaScript (web/decoder): its own tests, and the same values and the same refusals as ours."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import educational_decoder2
from benchmarks.damage import mutate_bytes, mutate_sealed
from flexgs_edge.codec.open_fgs import open_fgs, verify
from flexgs_edge.codec.v2.container import trim_container, write_grid
from flexgs_edge.errors import FormatError
from flexgs_edge.scene.fields import FIELD
from flexgs_edge.viewer.assets import web_files
from grid_scenes import make_grid
from web_vectors import FOLDER, KINDS, expected, write_all, write_expected

REPOSITORY = Path(__file__).resolve().parents[2]
DECODER = REPOSITORY / "web" / "decoder"
CORPUS = REPOSITORY / "tests" / "fuzz" / "corpus"
SEEDS = REPOSITORY / "tests" / "golden"
DAMAGED = int(os.environ.get("FLEXGS_DAMAGED", "200"))
SLOW = 5.0
"""Seconds that no small file may take, on a busy machine."""


@pytest.fixture(scope="module")
def node() -> str:
    found = shutil.which("node")
    if found is None:
        pytest.skip("no node: the decoder in JavaScript runs in it")
    version = subprocess.run([found, "--version"], capture_output=True, text=True, check=True).stdout
    if int(version.lstrip("v").split(".")[0]) < 18:
        pytest.skip(f"node {version.strip()}: the decoder in JavaScript needs 18 or later")
    return found


def compare(node: str, folder: Path) -> dict[str, Any]:
    """What the decoder reads differently from `expected.json`."""
    command = [node, str(DECODER / "tests" / "compare.mjs"), str(folder)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, timeout=250)
    assert result.returncode == 0, result.stderr
    record: dict[str, Any] = json.loads(result.stdout)
    return record


def outcome(path: Path) -> dict[str, Any]:
    """What our decoder reads, or says."""
    try:
        return expected(path)
    except FormatError as error:
        return {"error": str(error).removeprefix(f"{path.parent}/")}


def test_its_own_tests_pass(node: str) -> None:
    files = sorted(str(path) for path in (DECODER / "tests").glob("*.test.mjs"))
    result = subprocess.run([node, "--test", *files], capture_output=True, text=True, check=False, timeout=250)
    assert result.returncode == 0, result.stdout[-5000:]


def test_a_page_of_version_2_refuses_version_1(node: str, tmp_path: Path) -> None:
    for path, text in web_files(version=2).items():
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / path).write_text(text)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    script = (
        "const { open } = await import(process.argv[1]);\n"
        "const { readFileSync } = await import('node:fs');\n"
        "const tried = process.argv.slice(2).map((path) => open(readFileSync(path)).then((file) => file.count, String));\n"
        "console.log((await Promise.all(tried)).join('\\n'));"
    )
    names = [FOLDER / "255_rows.fgs", FOLDER / "version_1_no_SH.fgs"]
    command = [node, "--input-type=module", "-e", script, str(tmp_path / "decoder/src/index.js"), *map(str, names)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.splitlines() == [
        "255",
        "FgsError: byte 8: version: wanted 2, got 1: flexgs-edge view makes a page for it",
    ]


def test_the_vectors_are_read_as_they_say() -> None:
    """By our decoder; theirs is in its own tests. A writer may get better, so the files are not compared."""
    record = json.loads((FOLDER / "vectors.json").read_text())
    assert len(record) >= len(KINDS)
    assert {path.name for path in FOLDER.glob("*.fgs")} == set(record)
    for name, wanted in record.items():
        assert expected(FOLDER / name) == wanted, name


@pytest.mark.parametrize(
    "name",
    ["degree_4_SH_beyond_the_limit_of_a_sum", "escapes", "chunks_of_one_row", "a_preview_before_chunks_of_256_rows"],
)
def test_a_vector_is_read_from_the_page_alone(name: str) -> None:
    """By the decoder that follows docs/format.md and knows nothing of the package."""
    path = FOLDER / f"{name}.fgs"
    _, values = educational_decoder2.decode(path.read_bytes())
    source = open_fgs(path)
    for field, planes in source.read(slice(0, source.count), list(FIELD)).items():
        assert planes.tobytes() == np.ascontiguousarray(values[field]).tobytes(), field


def test_what_the_writer_makes_today(node: str, tmp_path: Path) -> None:
    files = list(write_all(tmp_path).values())
    for layers in (1, 3):
        for degree in (0, 3):
            path = tmp_path / f"{layers}_{degree}.fgs"
            write_grid(path, make_grid(3000, degree, layers=layers), {}, chunk_rows=1024)
            files.append(path)
    for size in (26_000, 30_000):
        path = tmp_path / f"cut_{size}.fgs"
        trim_container(tmp_path / "3_0.fgs", path, size)
        files.append(path)
    write_expected(files, tmp_path / "expected.json")
    assert compare(node, tmp_path)["different"] == []


def write_damaged(folder: Path) -> None:
    """Damaged files, and the corpus."""
    draw = random.Random(33)
    seeds = [
        (path.read_bytes(), verify(path))
        for path in (
            SEEDS / "v1/tiny.fgs",
            SEEDS / "v2/tiny.fgs",
            FOLDER / "chunks_of_one_row.fgs",
            FOLDER / "255_rows.fgs",
        )
    ]
    for i in range(DAMAGED):
        data, sections = seeds[i % len(seeds)]
        made = mutate_bytes(draw, data) if i % 10 < 3 else mutate_sealed(draw, data, sections)
        (folder / f"{i:04d}.fgs").write_bytes(made)
    for path in CORPUS.glob("*.fgs"):
        (folder / path.name).write_bytes(path.read_bytes())


def test_damaged_files_are_refused_with_the_same_words(node: str, tmp_path: Path) -> None:
    """Bits, bytes, numbers, pieces, JSON; a part of the files with correct checksums."""
    write_damaged(tmp_path)
    outcomes = {path.name: outcome(path) for path in sorted(tmp_path.glob("*.fgs"))}
    assert sum("error" in record for record in outcomes.values()) > DAMAGED // 2
    (tmp_path / "expected.json").write_text(json.dumps(outcomes))
    record = compare(node, tmp_path)
    assert list(unlike(record["different"])) == []
    assert record["files"] >= DAMAGED and record["seconds"] < SLOW


HEADERS = """
import { isDeepStrictEqual } from 'node:util';
import { readFileSync } from 'node:fs';
const [long, short] = await Promise.all(process.argv.slice(1, 3).map((path) => import(path)));
const read = (decoder, text) => {
  try {
    return decoder.decodeHeader2(new TextEncoder().encode(text));
  } catch (error) {
    return error.constructor.name === 'HeaderError' ? null : error;
  }
};
const found = JSON.parse(readFileSync(0, 'utf8')).map((text) => [read(long, text), read(short, text)]);
console.log(JSON.stringify(found.map(([one, two]) => [one !== null, isDeepStrictEqual(one, two)])));
"""
ODD = ["null", "true", "-1", "0", "3", "4", "0.5", "1.5", "1e300", "1e999", "NaN", "2097152", '"3"', "[]", "[0]", "{}"]


def odd_headers(header: dict[str, Any]) -> Iterable[str]:
    """The header, and with each value replaced, each key left out, and a further key; also those of objects and lists in it."""
    yield json.dumps(header)
    for path in places(header):
        for value in ODD:
            if not (path[0] in {"origin", "steps"} and value.lstrip("-").isdigit()):
                yield changed(header, path, "@").replace('"@"', value)
        yield changed(header, path, None)
        yield changed(header, (*path[:-1], "further"), 1)
    yield from ("", "[]", "null", "3", "{", '{"é": 1}')


def places(value: Any) -> Iterable[tuple[Any, ...]]:
    pairs = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in pairs:
        yield (key,)
        if key != "settings":
            yield from ((key, *path) for path in places(inner))


def changed(header: dict[str, Any], path: tuple[Any, ...], value: Any) -> str:
    copy = json.loads(json.dumps(header))
    inner = copy
    for key in path[:-1]:
        inner = inner[key]
    if isinstance(inner, list) and path[-1] == "further":
        inner.append(value)
    elif value is None:
        del inner[path[-1]]
    else:
        inner[path[-1]] = value
    return json.dumps(copy)


@pytest.mark.parametrize(
    "name", ["contracted", "a_preview_before_chunks_of_256_rows", "degree_4_SH_beyond_the_limit_of_a_sum"]
)
def test_pages_refuse_the_same_headers(node: str, name: str) -> None:
    """But for integers in the place of other numbers, which say the same."""
    data = (FOLDER / f"{name}.fgs").read_bytes()
    header = json.loads(data[36 : 36 + int.from_bytes(data[24:28], "little")])
    header |= {"cut_from": {"bytes": 5, "count": 6, "layers": 7}}
    texts = list(odd_headers(header))
    modules = [str(DECODER / "src" / file) for file in ("header2.js", "header2-short.js")]
    command = [node, "--input-type=module", "-e", HEADERS, *modules]
    result = subprocess.run(command, input=json.dumps(texts), capture_output=True, text=True, check=True, timeout=60)
    record = json.loads(result.stdout)
    assert record[0] == [True, True] and sum(not taken for taken, _ in record) > len(texts) // 2
    assert [text for text, (_, same) in zip(texts, record, strict=True) if not same] == []


def test_nothing_large_is_made_on_a_files_word(node: str, tmp_path: Path) -> None:
    """A file that is refused gets no array of more than four times its size, others none larger than what they hold."""
    write_damaged(tmp_path)
    for path in FOLDER.glob("*.fgs"):
        (tmp_path / path.name).write_bytes(path.read_bytes())
    command = [node, str(DECODER / "tests" / "allocations.mjs"), str(tmp_path)]
    result = subprocess.run(command, capture_output=True, text=True, check=True, timeout=250)
    record = json.loads(result.stdout)
    assert sum(file["refused"] for file in record) > DAMAGED // 2 and max(file["all"] for file in record) > 100_000
    for file in record:
        room = 4 * file["size"] if file["refused"] else max(4 * file["size"], file["values"])
        assert file["largest"] <= room, file
        assert file["all"] <= 12 * max(4 * file["size"], file["values"]), file


CORRECT = """
import { FgsError, looksLikeFgs, open, prefetch, type Chunk, type Source } from '@flexgs/decoder';
import { openInWorker } from '@flexgs/decoder/worker';

export async function read(source: Source): Promise<number> {
  const file = await open(source, { name: 'a', fetch: { credentials: 'omit' } });
  let sum = file.origin[0] + file.layers.length + (file.header.steps?.sh[0] ?? 0);
  for await (const chunk of file.chunks({ sh: false, layers: 1 })) sum += add(chunk);
  const remote = await openInWorker(await prefetch('scene.fgs'));
  for await (const chunk of remote.chunks({ values: true })) sum += chunk.values?.means[0] ?? 0;
  await remote.close();
  return sum + Number(looksLikeFgs(new Uint8Array(4)));
}

function add(chunk: Chunk): number {
  const { means, quats } = chunk.values();
  return means[0] + quats.length + ('position' in chunk.codes ? chunk.codes.position[2][0] : 0);
}

export const offset = (error: unknown): number => (error instanceof FgsError ? error.offset : -1);
"""


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        ("", "", None),
        ("file.origin[0]", "file.origin[3]", "TS2493"),
        ("layers: 1 }", "layer: 1 }", "TS2561"),
        ("chunk.values?.means", "chunk.values?.mean", "TS2551"),
        ("open(source,", "open(5,", "TS2345"),
    ],
)
def test_its_types(node_modules: Path, tmp_path: Path, old: str, new: str, fault: str | None) -> None:
    """By TypeScript's compiler: a page that uses all of it, and faults in it."""
    compiler = node_modules / "typescript" / "bin" / "tsc"
    if not compiler.is_file():
        pytest.skip(f"no typescript in {node_modules}: npm install typescript@5")
    assert old in CORRECT
    (tmp_path / "use.mts").write_text(CORRECT.replace(old, new))
    scope = tmp_path / "node_modules" / "@flexgs"
    scope.mkdir(parents=True)
    (scope / "decoder").symlink_to(DECODER)
    options = ["--noEmit", "--strict", "--target", "es2022", "--module", "nodenext", "--lib", "es2022,dom,dom.iterable"]
    command = ["node", str(compiler), *options, "use.mts"]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=250)
    if fault is None:
        assert result.returncode == 0, result.stdout
    else:
        assert result.returncode != 0 and fault in result.stdout, result.stdout


def unlike(different: Iterable[dict[str, Any]]) -> Iterable[dict[str, Any]]:
    """Differences but for the words of Python's JSON parser and how deep it goes, which change with its version."""
    for record in different:
        texts = [record[side].get("error", "") for side in ("wanted", "got")]
        about_json = "wanted JSON" in texts[1] and ("wanted JSON" in texts[0] or "nested too deep" in texts[1])
        if not (about_json and all(": header: " in text for text in texts)):
            yield record
