"""Join modules of JavaScript into one short script, for a page that may load nothing.

Only the forms of `import` and `export` that our own modules use are understood; a test joins all of them.
"""

import posixpath
import re
from collections.abc import Mapping
from importlib.util import find_spec
from string import ascii_letters

_SHADER = re.compile(r"`#version[^`]*`")
_IMPORT = re.compile(r"^import (?:\{([^}]*)\} from )?'([^']+)';$", re.MULTILINE)
_EXPORT_FROM = re.compile(r"^export \{([^}]*)\} from '([^']+)';$", re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:function\*?|class|const) \w+)", re.MULTILINE)
_NAME = re.compile(r"^(?:async )?(?:function\*?|class|const|let) (\w+)", re.MULTILINE)
_NUMBER = re.compile(r"^const ([A-Z][A-Z0-9_]*) = (\d[0-9a-fx .*/<-]*);(?: //.*)?\n", re.MULTILINE)
_LOCAL = re.compile(r"(?<=[ (])const (?=\w+ (?:=|of) |[\[{])")  # In functions: of others, engines know that they stay
_LEFT = re.compile(r"^(?:import|export|const [{[]|let [{[]).*$", re.MULTILINE)
_OUTSIDE = re.compile(r"\b(?:uniform|in|out) [^;(){}]*;")  # Names that the page or another shader of GLSL knows
_DECLARED = re.compile(r"\b(?:float|int|u?vec[234]|mat3|void) (\w+)|, (\w+) = ")
_DIGITS = re.compile(r"\d+\.\d{9,}")
_ZERO = re.compile(r"\b0(?=\.0*[1-9])|(?<=\d\.)0\b")  # GLSL knows .5 and 1.


def shorten_script(text: str) -> str:
    """A script of JavaScript that does the same; shaders in it lose comments and spaces."""
    return _shorten("application/javascript", _SHADER.sub(lambda found: shorten_shader(found[0]), text))


def shorten_style(text: str) -> str:
    """A style that says the same."""
    return _shorten("text/css", text)


def _shorten(kind: str, text: str) -> str:
    # For some machines there is no wheel (Apple's processors, November 2026). Pages are longer there, and work as well.
    if find_spec("minify") is None:
        return text
    import minify  # a runtime of its own, which only pages need

    return str(minify.string(kind, text))


def join_modules(files: Mapping[str, str], entries: Mapping[str, str]) -> str:
    """One short script that does what one of several modules does.

    On a page it is the entry `page`, in a worker the one with the worker's name: page and workers share one text, which it
    knows as `ownScript()`. All modules but the entries share one scope, since that makes the script shorter: no two of them
    may have one name at their top, and none may import under another name.

    `files`: texts by path. `entries`: paths of the modules to run, by name. Raises `ValueError` for an import, export
    or name of a form that is not understood, and for a name that two modules have.
    """
    parts: dict[str, str] = {}
    for path in entries.values():
        _add(files, path, parts)
    begin = [f"{name}() {{\n{parts.pop(path)}\n}}," for name, path in entries.items()]
    _check_names(parts)
    body = "\n".join([*parts.values(), "const entries = {", *begin, "};"])
    chosen = "entries[globalThis.document ? 'page' : globalThis.name]();"
    own = "const ownScript = () => `(${joined})()`;"
    body = _LOCAL.sub("let ", _with_numbers(body))  # one word for both, for gzip
    return shorten_script(f"(function joined() {{\n'use strict';\n{own}\n{body}\n{chosen}\n}})();") + "\n"


def _with_numbers(text: str) -> str:
    """Numbers in the place of their names, which the minifier would keep. No string of ours may hold such a name."""
    numbers = dict(_NUMBER.findall(text))
    text = _NUMBER.sub("", text)
    for name, number in numbers.items():
        text = re.sub(rf"(?<![\w.]){name}\b", f"({number})", text)
    return text


def _add(files: Mapping[str, str], path: str, parts: dict[str, str]) -> None:
    """Add a module after all that it imports."""
    if path in parts:
        return
    text = files[path]
    folder = posixpath.dirname(path)
    for pattern in (_IMPORT, _EXPORT_FROM):
        for found in pattern.finditer(text):
            if " as " in (found[1] or ""):
                raise ValueError(f"{path}: cannot join {found[0]!r}")
            _add(files, posixpath.normpath(posixpath.join(folder, found[2])), parts)
    text = _EXPORT.sub("", _EXPORT_FROM.sub("", _IMPORT.sub("", text)))
    if left := _LEFT.search(text):
        raise ValueError(f"{path}: cannot join {left[0]!r}")
    parts[path] = text.strip()


def _check_names(parts: Mapping[str, str]) -> None:
    owners: dict[str, str] = {}
    for path, text in parts.items():
        # A template may hold lines that look like ours.
        for name in _NAME.findall(re.sub(r"`[^`]*`", "", text)):
            if name in owners:
                raise ValueError(f"{path} and {owners[name]} both have {name}")
            owners[name] = path


def shorten_shader(text: str) -> str:
    """A shader without comments, indentation and most spaces, with short names and no digits that float32 cannot hold."""
    text = re.sub(r"\n\s+", "\n", re.sub(r"[ \t]*//[^\n]*", "", text))
    text = _ZERO.sub("", _DIGITS.sub(lambda found: f"{float(found[0]):.9g}", _renamed(text)))
    text = re.sub(r" ?([*/=<>(){},;?:&|!]+) ?", r"\1", text)
    text = re.sub(r"(?<=[(){},;])\n(?!#)", "", text)
    # Two signs beside each other would become another one.
    return re.sub(r"(?<![+-]) ?([+-]=?) ?(?![+-])", r"\1", text)


def _renamed(text: str) -> str:
    """A shader with names of one letter."""
    used = set(re.findall(r"\w+", text))
    known = set(re.findall(r"\w+", " ".join(_OUTSIDE.findall(text)))) | {"main"}
    declared = [one or other for one, other in _DECLARED.findall(_OUTSIDE.sub("", text))]
    own = [name for name in dict.fromkeys(declared) if name not in known and len(name) > 1]
    free = (letter for letter in ascii_letters if letter not in used)
    for old, new in zip(own, free, strict=False):
        text = re.sub(rf"(?<![.\w]){old}\b", new, text)
    return text
