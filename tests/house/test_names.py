"""House rules: a name for each module, packages that only hand on, imports that do nothing, private names that stay private."""

from __future__ import annotations

import ast
import shutil
from collections import defaultdict
from functools import cache
from pathlib import Path

import pytest

PACKAGE = "flexgs_edge"
DEFINING = ("kernels/twins/__init__.py",)
"""The table of twins, beside the twins."""
FACE = "__init__.py"
"""The package's own face may have what loads its names when they are first used."""
LAZY = {"_HOMES", "__getattr__", "__dir__", "__all__"}
# Places that answer one question: a command and its options, two versions of the file, every method.
ALIKE = ({"commands", "cli"}, {"codec/v1", "codec/v2"}, {"methods/best", "methods/foreign", "methods/paper"})
SHARED = {"header": "codec"}
"""Names that a further folder may have: what the headers of both versions share."""
REGISTERING = {"register", "add_command", "command", "group"}


parsed = cache(ast.parse)
"""Copies of the package have the same texts but one."""


def modules(package: Path) -> dict[str, ast.Module]:
    """Every module by its path in the package."""
    return {
        path.relative_to(package).as_posix(): parsed(path.read_text(encoding="utf-8"))
        for path in sorted(package.rglob("*.py"))
    }


def is_docstring(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def assigned(statement: ast.stmt) -> set[str]:
    """Names that a statement binds; "" for any other target."""
    if isinstance(statement, (ast.FunctionDef, ast.ClassDef)):
        return {statement.name}
    targets = statement.targets if isinstance(statement, ast.Assign) else [getattr(statement, "target", None)]
    found: set[str] = set()
    for target in targets:
        parts = target.elts if isinstance(target, ast.Tuple) else [target]
        found |= {part.id if isinstance(part, ast.Name) else "" for part in parts}
    return found


def is_type_checking(statement: ast.stmt) -> bool:
    return isinstance(statement, ast.If) and ast.unparse(statement.test) == "TYPE_CHECKING"


def attaches_stub(statement: ast.stmt) -> bool:
    """`__getattr__, __dir__, __all__ = lazy.attach_stub(...)`."""
    value = getattr(statement, "value", None)
    return isinstance(value, ast.Call) and ast.unparse(value.func).rpartition(".")[2] == "attach_stub"


def packages_that_define(package: Path) -> list[str]:
    """`__init__` files that do more than hand names on."""
    found = []
    for name, tree in modules(package).items():
        if not name.endswith("__init__.py") or name in DEFINING:
            continue
        allowed = LAZY if name == FACE else {"__all__"}
        for statement in tree.body:
            if isinstance(statement, (ast.Import, ast.ImportFrom)) or is_docstring(statement):
                continue
            if name == FACE and (is_type_checking(statement) or attaches_stub(statement)):
                continue
            if not assigned(statement) <= allowed:
                found.append(f"{name}:{statement.lineno}: {ast.unparse(statement).splitlines()[0]}")
    return found


def names_that_occur_twice(package: Path, kernels: Path) -> dict[str, set[str]]:
    """Folders by the module name that they share, where these are not places that answer one question."""
    folders: dict[str, set[str]] = defaultdict(set)
    sources = {path.stem.removesuffix("_cpu").removesuffix("_gpu") for path in kernels.glob("*.cl")}
    for name in modules(package):
        folder, _, module = name.removesuffix(".py").rpartition("/")
        if module == "__init__" or (folder == "kernels/twins" and module in sources):
            continue
        folders[module].add(folder)
    return {
        module: places
        for module, places in folders.items()
        if len(places) > 1 and not any(places - {SHARED.get(module)} <= alike for alike in ALIKE)
    }


def calls_on_import(package: Path) -> list[str]:
    """Statements of modules that do something, and decorators that enter what they decorate into a register."""
    found = []
    for name, tree in modules(package).items():
        for statement in tree.body:
            acts = isinstance(statement, (ast.Expr, ast.For, ast.While, ast.With, ast.AugAssign, ast.Delete))
            if acts and not is_docstring(statement):
                found.append(f"{name}:{statement.lineno}: {ast.unparse(statement).splitlines()[0]}")
            if isinstance(statement, ast.Assign) and "" in assigned(statement):
                found.append(f"{name}:{statement.lineno}: {ast.unparse(statement).splitlines()[0]}")
            for decorator in getattr(statement, "decorator_list", ()):
                function = decorator.func if isinstance(decorator, ast.Call) else decorator
                owner, _, method = ast.unparse(function).rpartition(".")
                if method in REGISTERING and owner != "click":
                    found.append(f"{name}:{statement.lineno}: @{ast.unparse(decorator)}")
    return found


def is_private(name: str) -> bool:
    return name.startswith("_") and not name.startswith("__")


def private_names_elsewhere(package: Path) -> list[str]:
    """Private names and modules of ours that another module imports, or reaches through an imported module."""
    trees = modules(package)
    known = {name.removesuffix(".py").replace("/", ".") for name in trees}
    found = []
    for name, tree in trees.items():
        ours: set[str] = set()
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.level or (node.module or "").startswith(PACKAGE)):
                home = (node.module or "").removeprefix(PACKAGE).lstrip(".")
                for alias in node.names:
                    if f"{home}.{alias.name}".lstrip(".") in known:
                        ours.add(alias.asname or alias.name)
                    if is_private(alias.name):
                        found.append(f"{name}:{node.lineno}: {alias.name}")
                # `_version` is the ground's, for the build as well.
                if any(is_private(part) for part in home.split(".")) and home != "_version":
                    found.append(f"{name}:{node.lineno}: {home}")
        for node in ast.walk(tree):
            reached = isinstance(node, ast.Attribute) and is_private(node.attr) and isinstance(node.value, ast.Name)
            if reached and node.value.id in ours:
                found.append(f"{name}:{node.lineno}: {ast.unparse(node)}")
    return found


def test_packages_only_hand_on(repository: Path) -> None:
    assert packages_that_define(repository / PACKAGE) == []


def test_no_name_occurs_twice_by_accident(repository: Path) -> None:
    assert len(modules(repository / PACKAGE)) > 100
    assert names_that_occur_twice(repository / PACKAGE, repository / "cl_kernels") == {}


def test_nothing_happens_on_import(repository: Path) -> None:
    assert calls_on_import(repository / PACKAGE) == []


def test_private_names_stay_in_their_module(repository: Path) -> None:
    assert private_names_elsewhere(repository / PACKAGE) == []


@pytest.fixture
def planted(repository: Path, tmp_path: Path) -> Path:
    """A copy of the rooms that faults are planted in."""
    ignored = shutil.ignore_patterns("__pycache__", "studies", "methods", "render", "memory", "quality")
    return Path(shutil.copytree(repository / PACKAGE, tmp_path / PACKAGE, ignore=ignored))


def plant(package: Path, module: str, statement: str) -> None:
    with (package / module).open("a", encoding="utf-8") as file:
        file.write(f"\n{statement}\n")


@pytest.mark.parametrize(
    ("module", "statement"),
    [
        ("scene/__init__.py", "LARGEST = 5"),
        ("io/__init__.py", "def read() -> None: ..."),
        ("views/__init__.py", "if True:\n    import os"),
        ("__init__.py", "def helper() -> None: ..."),
    ],
)
def test_a_package_that_defines_is_seen(planted: Path, module: str, statement: str) -> None:
    plant(planted, module, statement)
    (found,) = packages_that_define(planted)
    assert found.startswith(f"{module}:")


def test_a_lazy_face_is_allowed(planted: Path) -> None:
    (planted / FACE).write_text(
        '"""Face."""\nimport lazy_loader as lazy\n__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)\n'
    )
    assert packages_that_define(planted) == []


@pytest.mark.parametrize("module", ["run/ply.py", "codec/v2/open_fgs.py", "run/compress.py", "report/evaluate.py"])
def test_a_name_that_occurs_twice_is_seen(planted: Path, repository: Path, module: str) -> None:
    plant(planted, module, "")
    folder, _, name = module.removesuffix(".py").rpartition("/")
    found = names_that_occur_twice(planted, repository / "cl_kernels")
    assert list(found) == [name] and folder in found[name]


@pytest.mark.parametrize(
    "statement",
    [
        "register_reader('.xyz', None)",
        "for kind in (): READERS.append(kind)",
        "READERS['.xyz'] = None",
        "@READERS.register\ndef read() -> None: ...",
        "@app.command('extra')\ndef extra() -> None: ...",
    ],
)
def test_a_registration_is_seen(planted: Path, statement: str) -> None:
    plant(planted, "io/formats.py", statement)
    (found,) = calls_on_import(planted)
    assert found.startswith("io/formats.py:")


@pytest.mark.parametrize(
    "statement",
    [
        "from flexgs_edge.io.ply import _smooth",
        "def late() -> None:\n    from .ply import _smooth",
        "from flexgs_edge.io import ply\nSPAN = ply._SPAN",
        "from flexgs_edge._hidden import anything",
    ],
)
def test_a_private_name_elsewhere_is_seen(planted: Path, statement: str) -> None:
    plant(planted, "io/formats.py", statement)
    (found,) = private_names_elsewhere(planted)
    assert found.startswith("io/formats.py:")
