"""Join modules of JavaScript into one script, for a page that may load nothing.

Only the forms of `import` and `export` that our own modules use are understood; a test joins all of them.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Mapping

_IMPORT = re.compile(r"^import (?:\{([^}]*)\} from )?'([^']+)';$", re.MULTILINE)
_EXPORT_FROM = re.compile(r"^export \{([^}]*)\} from '([^']+)';$", re.MULTILINE)
_EXPORT = re.compile(r"^export ((?:async )?function\*? |class |const )(\w+)", re.MULTILINE)
_COMMENT = re.compile(r"^[ \t]*(?:/\*.*?\*/|//[^\n]*)[ \t]*$", re.MULTILINE | re.DOTALL)
_SPACE = re.compile(r"\n\s+")
_LEFT = re.compile(r"^(?:import|export)\b.*$", re.MULTILINE)


def join_modules(files: Mapping[str, str], entry: str) -> str:
    """One script that does what the module `entry` does.

    Comments that stand alone and indentation are left out: with them, a page would be half as large again. Each module
    becomes a function of its own, so that names in two modules do not meet, and hands over what it exports.

    Parameters
    ----------
    files : mapping
        Texts by path.
    entry : str
        Path of the module to run.

    Raises
    ------
    ValueError
        For an import or export of a form that is not understood.
    """
    parts: dict[str, str] = {}
    _add(files, entry, parts)
    body = _SPACE.sub("\n", _COMMENT.sub("", "\n".join(parts.values())))
    return f"(() => {{\n'use strict';\nconst modules = {{}};\n{body}\n}})();\n"


def _add(files: Mapping[str, str], path: str, parts: dict[str, str]) -> None:
    """Add a module after all that it imports."""
    if path in parts:
        return
    text = files[path]
    folder = posixpath.dirname(path)

    def other(place: str) -> str:
        return posixpath.normpath(posixpath.join(folder, place))

    for pattern in (_IMPORT, _EXPORT_FROM):
        for found in pattern.finditer(text):
            _add(files, other(found[2]), parts)
    exported: list[str] = []

    def take(found: re.Match[str]) -> str:
        if not found[1]:
            return ""
        return f"const {{{_names(found[1])}}} = modules['{other(found[2])}'];"

    def pass_on(found: re.Match[str]) -> str:
        exported.extend(f"get {name}() {{ return modules['{other(found[2])}'].{name}; }}" for name in _list(found[1]))
        return ""

    def keep(found: re.Match[str]) -> str:
        exported.append(f"get {found[2]}() {{ return {found[2]}; }}")
        return f"{found[1]}{found[2]}"

    text = _EXPORT.sub(keep, _EXPORT_FROM.sub(pass_on, _IMPORT.sub(take, text)))
    if left := _LEFT.search(text):
        raise ValueError(f"{path}: cannot join {left[0]!r}")
    parts[path] = f"modules['{path}'] = (() => {{\n{text.strip()}\nreturn {{ {', '.join(exported)} }};\n}})();"


def _list(names: str) -> list[str]:
    return [name.strip() for name in names.split(",") if name.strip()]


def _names(names: str) -> str:
    """`{ a, b as c }` as a pattern: `a, b: c`."""
    return ", ".join(name.replace(" as ", ": ") for name in _list(names))
