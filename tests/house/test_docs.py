"""What the pages name exists: files, links, anchors, modules, options. And their tables are those of the file of figures."""

from __future__ import annotations

import importlib
import re
import shlex
import tokenize
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import click
import pytest

from benchmarks import figures

FENCE = re.compile(r"^ *```.*?^ *```", re.DOTALL | re.MULTILINE)
SPAN = re.compile(r"`[^`\n]+`")
LINK = re.compile(r"\]\(([^()\s]+)\)")
HEADING = re.compile(r"^#+ +(.+?) *$", re.MULTILINE)
NAMED_ANCHOR = re.compile(r"<a (?:id|name)=\"([^\"]+)\"")
FOLDERS = "flexgs_edge|cl_kernels|benchmarks|tests|deploy|docs|samples|\\.ci"
PATH = re.compile(rf"(?<![\w./-])(?:{FOLDERS})/[\w./-]*\w/?")
SOURCE = re.compile(r"(?<![\w./*-])(?:[\w-]+/)*[\w-]+\.(?:py|clh?|sh)\b(?!\()")
MODULE = re.compile(r"(?<![\w./-])(?:flexgs_edge|benchmarks)(?:\.[a-zA-Z_]\w*)+")
SHOWN = re.compile(r"(?:^\s*|`|^\s+deploy/.* )flexgs-edge [a-z][^`]*")
DOCS_NAMED = re.compile(r"(docs/[\w/]+\.md)(#[\w-]+)?")


def pages_of(root: Path) -> list[Path]:
    tops = [root / name for name in ("README.md", "CHANGELOG.md", "CONTRIBUTING.md")]
    return [
        *tops,
        *(root / folder / "README.md" for folder in ("deploy", "benchmarks")),
        *sorted((root / "docs").rglob("*.md")),
    ]


def prose(text: str) -> str:
    """A page without its blocks of code and code in lines."""
    return SPAN.sub("`", FENCE.sub("", text))


def anchors(page: Path) -> set[str]:
    """Anchors as GitHub makes them from headings, and those that the page spells out."""
    text, seen, found = page.read_text(encoding="utf-8"), Counter[str](), set()
    for heading in HEADING.findall(FENCE.sub("", text)):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading).lower()
        slug = re.sub(r"[^\w\- ]", "", words).replace(" ", "-")
        found.add(f"{slug}-{seen[slug]}" if seen[slug] else slug)
        seen[slug] += 1
    return found | set(NAMED_ANCHOR.findall(text))


def places(page: Path, pattern: re.Pattern[str]) -> Iterator[tuple[int, str]]:
    """Line number and text of every match."""
    for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1):
        for found in pattern.finditer(line):
            yield number, found.group()


def test_links_and_anchors_lead_somewhere(repository: Path) -> None:
    missing = []
    for page in pages_of(repository):
        for target in LINK.findall(prose(page.read_text(encoding="utf-8"))):
            if re.match(r"[a-z]+:", target):
                continue
            path, _, anchor = target.partition("#")
            place = (page.parent / path).resolve() if path else page
            if not place.exists():
                missing.append(f"{page.relative_to(repository)}: no {target}")
            elif anchor and anchor not in anchors(place):
                missing.append(f"{page.relative_to(repository)}: no heading of {target}")
    assert not missing, "\n".join(missing)


def test_no_page_spells_an_anchor_twice(repository: Path) -> None:
    for page in pages_of(repository):
        spelt = Counter(NAMED_ANCHOR.findall(page.read_text(encoding="utf-8")))
        assert not [anchor for anchor, times in spelt.items() if times > 1], page


def test_paths_that_pages_name_exist(repository: Path) -> None:
    roots = (
        repository,
        *(repository / name for name in ("flexgs_edge", "benchmarks", "cl_kernels", "tests", "deploy", "docs")),
    )
    known = {path.name for root in roots[1:] for path in root.rglob("*.*")}
    missing = set()
    for page in pages_of(repository):
        name = page.relative_to(repository)
        missing |= {f"{name}:{k}: no {path}" for k, path in places(page, PATH) if not (repository / path).exists()}
        for k, path in places(page, SOURCE):
            there = any((root / path).exists() for root in roots) if "/" in path else path in known
            if not there:
                missing.add(f"{name}:{k}: no {path}")
    assert not missing, "\n".join(sorted(missing))


def resolves(name: str) -> bool:
    """Whether a dotted name is a module, or something that a module holds."""
    words = name.split(".")
    for k in range(len(words), 0, -1):
        try:
            found = importlib.import_module(".".join(words[:k]))
        except ModuleNotFoundError:
            continue
        return k == len(words) or hasattr(found, words[k])
    return False


def test_modules_that_pages_name_exist(repository: Path) -> None:
    named = {(page.relative_to(repository), name) for page in pages_of(repository) for _, name in places(page, MODULE)}
    missing = sorted(f"{page}: no {name}" for page, name in named if not resolves(name))
    assert not missing, "\n".join(missing)


def test_pages_that_the_code_names_exist(repository: Path) -> None:
    missing = []
    folders = ("flexgs_edge", "cl_kernels", "benchmarks", "deploy", "tests")
    files = (
        path
        for name in folders
        for path in (repository / name).rglob("*.*")
        if path.suffix in (".py", ".cl", ".clh", ".sh")
    )
    for file in sorted(files):
        for page, anchor in DOCS_NAMED.findall(file.read_text(encoding="utf-8")):
            place = repository / page
            if not place.exists() or (anchor and anchor[1:] not in anchors(place)):
                missing.append(f"{file.relative_to(repository)}: no {page}{anchor}")
    assert not missing, "\n".join(missing)


def remarks(file: Path) -> Iterator[tuple[int, str]]:
    """Line number and text of the comments and docstrings of a module, without the examples in them."""
    with open(file, "rb") as lines:
        last = tokenize.NEWLINE
        for token in tokenize.tokenize(lines.readline):
            starts = last in (tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT, tokenize.ENCODING)
            if token.type == tokenize.COMMENT:
                yield token.start[0], token.string
            elif token.type == tokenize.STRING and starts:
                for k, line in enumerate(token.string.splitlines()):
                    if ">>>" not in line and "..." not in line:
                        yield token.start[0] + k, line
            if token.type not in (tokenize.COMMENT, tokenize.NL):
                last = token.type


def test_no_remark_rests_on_one_scene(repository: Path) -> None:
    """A scene's name in a comment means a measurement: that belongs to docs/results/tuning.md."""
    scenes = re.compile(r"\b(?:fox|still_life|the sample)\b(?! (?:of|is|has|that))")
    package = repository / "flexgs_edge"
    files = [file for file in sorted(package.rglob("*.py")) if package / "studies" not in file.parents]
    missing = [
        f"{file.relative_to(repository)}:{k}: {line.strip()}"
        for file in files
        for k, line in remarks(file)
        if scenes.search(line)
    ]
    assert not missing, "\n".join(missing)


def leaves(command: click.Command, words: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], set[str]]]:
    """Every command with its words and its options; of groups, what is below as well."""
    with click.Context(command) as context:
        yield words, {name for param in command.get_params(context) for name in (*param.opts, *param.secondary_opts)}
        if isinstance(command, click.Group):
            for name in command.list_commands(context):
                below = command.get_command(context, name)
                assert below is not None
                yield from leaves(below, (*words, name))


def test_commands_and_options_that_pages_show_exist(repository: Path) -> None:
    known = dict(leaves(importlib.import_module("flexgs_edge.cli.app").command))
    missing = []
    for page in pages_of(repository):
        for k, line in places(page, SHOWN):
            words = shlex.split(line[line.index("flexgs-edge") :], comments=True)[1:]
            depth = next((n for n in (2, 1) if tuple(words[:n]) in known), 0)
            options = {word.partition("=")[0] for word in words if word.startswith("--")}
            if not depth or options - known[tuple(words[:depth])]:
                missing.append(f"{page.relative_to(repository)}:{k}: {line}")
    assert not missing, "\n".join(missing)


def test_tables_are_those_of_the_file_of_figures(repository: Path) -> None:
    assert figures.stale(repository) == [], "run: python -m benchmarks.figures tables"


def test_a_row_replaces_that_of_its_scene_and_command(tmp_path: Path) -> None:
    place = tmp_path / "figures.csv"
    row = dict.fromkeys(figures.COLUMNS, "1") | {"scene": "fox", "command": "compress --effort fast"}
    for new in (row, {**row, "scene": "still_life"}, {**row, "command": figures.DEFAULT}, {**row, "bytes": "2"}):
        figures.put(new, place)
    found = [(each["scene"], each["command"], each["bytes"]) for each in figures.read_rows(place)]
    assert found == [
        ("still_life", "compress --effort fast", "1"),
        ("fox", figures.DEFAULT, "1"),
        ("fox", "compress --effort fast", "2"),
    ]


def test_a_changed_table_is_found() -> None:
    rows = figures.read_rows()
    page = figures.rewritten("a\n<!-- figures: effort -->\nold\n<!-- end -->\nb\n", rows)
    assert "`--effort fast`" in page and "old" not in page and figures.rewritten(page, rows) == page
    for broken in ("<!-- figures: effort -->\n", "<!-- figures: nothing -->\n<!-- end -->"):
        with pytest.raises(figures.Missing):
            figures.rewritten(broken, rows)
